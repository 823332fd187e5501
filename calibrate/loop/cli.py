"""`brushloop loop compare`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX


def compare(
    original: Annotated[Path, typer.Argument(help="The session whose strokes were pressed again.")],
    again: Annotated[Path, typer.Argument(help="The session of the replay protocol.")],
    fit: Annotated[
        Path | None, typer.Option(help="Brush fit that recovered depth and tilt; else CCD-BSM as published.")
    ] = None,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    out: Annotated[Path, typer.Option(help="Folder for loop.html, loop.png, loop.csv, loop.json.")] = Path("loop"),
) -> None:
    """Compare re-pressed strokes with their originals, and with the brush's own repeatability."""
    import sys

    from brushloop.calibrate.loop.report import CompareRequest
    from brushloop.calibrate.loop.report import compare as run
    from brushloop.sessions.terminal import show_work

    show_work(run, CompareRequest(original, again, out, " ".join(["brushloop", *sys.argv[1:]]), fit, mm_per_px))
