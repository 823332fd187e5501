"""The report as data: the source of everything in terminal, JSON, tables, gates and comparisons."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar

from pydantic import BaseModel, ConfigDict

from calibrate.compare.field import Alignment, Tone
from calibrate.loop.scores import LoopRecord
from calibrate.report import Sealed, load_sealed
from calibrate.writing.scores import WrittenRecord
from sessions.recording.schemas import Source

FORMAT = "brushloop-validation-1"
MAX_BYTES = 256 * 1024 * 1024
PACKAGES = ("numpy", "opencv-python-headless", "scikit-image", "numba", "torch")


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Interval(_Frozen):
    """95 %, by bootstrap over the presses of each cell, or over cells where they have few."""

    low: float
    high: float


class Stat(_Frozen):
    """One model's scores in one alignment and tone, in percent; `cell` is (H, alpha), None for all of them."""

    model: str
    alignment: Alignment
    tone: Tone
    measure: str
    """`csim` or `ssim`."""
    cell: tuple[float, float] | None
    n: int
    max: float
    min: float
    avg: float
    avg_interval: Interval | None
    median: float
    median_interval: Interval | None


class CandidateInfo(_Frozen):
    """A row of the tables: what it is, and what it knew of the strokes."""

    name: str
    label: str
    definition: str
    basis: str
    sha256: str
    """Of a generator's file; empty for others."""


class Collected(_Frozen):
    """How the strokes were collected, from the session's journal."""

    planned: int | None
    """None where the protocol is no grid."""
    photographed: int
    pressed_again: tuple[str, ...]
    """Stroke of each take that did not count and was made again."""
    left_out: tuple[str, ...]
    touches: tuple[str, ...]
    """Method and height of every zero touch."""
    moved_mm: float
    """Highest less lowest paper."""


class Session(_Frozen):
    """A recording, from its header, and the artefacts that were used with it."""

    session_id: str
    source: Source
    recording: str
    recording_sha256: str
    recorded_with: str
    robot: str
    camera: str
    brush: str
    ink: str
    paper: str
    protocol: str
    origin: str
    licence: str
    strokes: int
    compared: int
    cut: tuple[str, ...]
    calibration: str
    """Digest; empty for an import, which brings its own scale."""
    mm_per_px: float | None
    mm_per_px_interval: Interval | None
    board_rms_px: float | None
    fit: str
    length_ratio: float | None
    width_ratio: float | None
    """Measured over CCD-BSM as published, on average over whole strokes."""
    collected: Collected | None = None
    """None where there is no journal: imports, and files that were sent alone."""


class Refused(_Frozen):
    """A stroke that was not compared, or not by one model, and why."""

    session_id: str
    stroke_id: str
    why: str


class Extreme(_Frozen):
    """One of the best or worst strokes of a model."""

    session_id: str
    stroke_id: str
    height_mm: float
    tilt_deg: float
    model: str
    csim: float
    ssim: float


class Step(_Frozen):
    """What a fit from so many presses scores on all other presses of the session."""

    session_id: str
    strokes: int
    model: str
    csim: float
    ssim: float
    n: int


class Report(Sealed):
    """Everything that was found."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop validate"

    format: str = FORMAT
    source: Source
    """What kind of ink, from the recordings' own headers; all tables and figures carry it."""
    software: dict[str, str]
    command: str
    mm_per_px: float
    ssim_settings: str
    sessions: tuple[Session, ...]
    rivals: tuple[CandidateInfo, ...]
    shown: str
    """The model of the pictures: the best calibrated one that has not seen what it predicts, if there is one."""
    stats: tuple[Stat, ...]
    cells_told: bool
    """False where there are too many different (H, alpha) for a table of each."""
    best: tuple[Extreme, ...]
    worst: tuple[Extreme, ...]
    refused: tuple[Refused, ...]
    by_strokes: tuple[Step, ...]
    """Similarity against number of strokes; empty without --ablations."""
    scores_sha256: str
    """Of scores.csv beside it."""
    loops: tuple[LoopRecord, ...] = ()
    """Strokes of these sessions that were pressed again: Table 1's third row."""
    written: tuple[WrittenRecord, ...] = ()
    """Characters: Table 3. Both are sealed by themselves, as they were found."""

    def stat(
        self,
        model: str,
        alignment: Alignment,
        tone: Tone,
        measure: str,
        cell: tuple[float, float] | None = None,
    ) -> Stat | None:
        """The scores of one model, or None where it has none."""
        for one in self.stats:
            if (one.model, one.alignment, one.tone, one.measure, one.cell) == (model, alignment, tone, measure, cell):
                return one
        return None

    @property
    def label(self) -> str:
        """What stands on every table and figure."""
        return str(self.source)


def load_report(path: Path) -> Report:
    """A report.json. Raises `CalibrationError` where it is none, or was edited."""
    return load_sealed(path, Report, MAX_BYTES)


def software() -> dict[str, str]:
    """Versions of what the numbers depend on."""
    return {"brushloop": version("brushloop"), "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }
