"""`brushloop loop compare` as a function."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.files import check_folder
from brushloop.calibrate.loop.compare import compare_sessions
from brushloop.calibrate.loop.report import PICTURE, summary, write_loop
from brushloop.calibrate.report import Written
from brushloop.sessions.terminal import Progress, unseen


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Which sessions are compared, and where the report goes."""

    original: Path
    again: Path
    """The session of the replay protocol."""
    out: Path
    command: str
    """Named by the report as what made it."""
    fit: Path | None = None
    """Brush fit that recovered depth and tilt; None is CCD-BSM as published."""
    mm_per_px: float = MM_PER_PX


def compare(request: CompareRequest, progress: Progress = unseen) -> Written:
    """Compare presses with those that repeat them, and write the report. Raises `CalibrationError`."""
    check_folder(request.out)
    view = Field(mm_per_px=request.mm_per_px)
    found = compare_sessions(request.original, request.again, request.fit, view, progress)
    report = write_loop(found, request.out, request.command)
    return Written(report, (*summary(found), f"Picture: {request.out / PICTURE}", f"Report:  {report}"))
