"""The report as data: the source of everything in terminal, JSON, tables, gates and comparisons."""

from __future__ import annotations

import platform
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.loop.scores import LoopRecord
from brushloop.calibrate.report import Sealed, load_sealed, source_label
from brushloop.calibrate.writing.scores import WrittenRecord
from brushloop.sessions.records import Source

FORMAT = "brushloop-validation-1"
MAX_BYTES = 256 * 1024 * 1024
PACKAGES = ("numpy", "opencv-python-headless", "scikit-image", "numba", "torch")


class Interval(Frozen):
    """95 % interval by bootstrap over the presses of each cell, or over cells if these have few presses."""

    low: float
    high: float


class Stat(Frozen):
    """One model's scores in one alignment and tone, in percent; `cell` is (H, alpha), or None for all cells."""

    model: str
    alignment: Alignment
    tone: Tone
    measure: str
    """`csim` or `ssim`."""
    cell: tuple[float, float] | None
    n: int
    max: float | None
    min: float | None
    avg: float
    avg_interval: Interval | None
    median: float | None
    """None for the ceiling, as are the extremes: it is an average of its own, not of scores."""
    median_interval: Interval | None
    below: float | None = None
    """Points below the ceiling over all cells together; None where no cell was pressed twice."""
    below_interval: Interval | None = None
    """95 % interval of that difference, which resamples whole cells."""


class CandidateInfo(Frozen):
    """A row of the tables: the model, and what it knew of the strokes."""

    name: str
    label: str
    definition: str
    basis: str
    sha256: str
    """Hash of a generator's file; empty for other models."""


class Collected(Frozen):
    """How the strokes were collected, from the session's journal."""

    planned: int | None
    """Number of strokes; None unless the protocol is a grid."""
    photographed: int
    pressed_again: tuple[str, ...]
    """Stroke of each take that did not count and was repeated."""
    left_out: tuple[str, ...]
    touches: tuple[str, ...]
    """Method and height of every zero touch."""
    moved_mm: float
    """Highest minus lowest height of the paper."""


class DepthMiss(Frozen):
    """A stroke, the depth that was commanded and the one that the arm reached."""

    stroke_id: str
    depth_mm: float
    reached_mm: float


class Session(Frozen):
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
    """Measured size divided by that of CCD-BSM as published, averaged over uncut strokes."""
    deepest_miss: DepthMiss | None = None
    """The stroke whose depths differ most; None where the recording has no reached depths."""
    collected: Collected | None = None
    """None without a journal: for imports, and for recordings sent without it."""


class Refused(Frozen):
    """A stroke that was not compared, or not with one of the models, and why."""

    session_id: str
    stroke_id: str
    why: str


class Extreme(Frozen):
    """One of the best or worst strokes of a model."""

    session_id: str
    stroke_id: str
    depth_mm: float
    tilt_deg: float
    model: str
    csim: float
    ssim: float


class Step(Frozen):
    """Scores of a fit from this many presses on all other presses of the session."""

    session_id: str
    strokes: int
    model: str
    csim: float
    ssim: float
    n: int


class Report(Sealed):
    """All results of a validation."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop validate"

    format: str = FORMAT
    source: Source
    """Kind of ink, from the recordings' own headers; shown on all tables and figures."""
    software: dict[str, str]
    command: str
    mm_per_px: float
    ssim_settings: str
    sessions: tuple[Session, ...]
    rivals: tuple[CandidateInfo, ...]
    shown: str
    """Model shown in the pictures: the best calibrated one on held-out cells, if there is one."""
    stats: tuple[Stat, ...]
    cells_told: bool
    """False if there are too many different (H, alpha) for a table of each."""
    best: tuple[Extreme, ...]
    worst: tuple[Extreme, ...]
    refused: tuple[Refused, ...]
    by_strokes: tuple[Step, ...]
    """Similarity against number of strokes; empty without --ablations."""
    scores_sha256: str
    """Hash of scores.csv in the same folder."""
    loops: tuple[LoopRecord, ...] = ()
    """Strokes of these sessions that were pressed again: the third row of Table 1."""
    written: tuple[WrittenRecord, ...] = ()
    """Characters: Table 3. Each record here and in `loops` keeps its own digest."""

    def stat(
        self,
        model: str,
        alignment: Alignment,
        tone: Tone,
        measure: str,
        cell: tuple[float, float] | None = None,
    ) -> Stat | None:
        """The scores of one model, or None if it has none."""
        for one in self.stats:
            if (one.model, one.alignment, one.tone, one.measure, one.cell) == (model, alignment, tone, measure, cell):
                return one
        return None

    @property
    def label(self) -> str:
        """Label of every table and figure."""
        return source_label(self.source, (session.brush for session in self.sessions))


def load_report(path: Path) -> Report:
    """Read a report.json. Raises `CalibrationError` if it is not one or was edited."""
    return load_sealed(path, Report, MAX_BYTES)


def software() -> dict[str, str]:
    """Versions of the software that the numbers depend on."""
    return {"brushloop": version("brushloop"), "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }
