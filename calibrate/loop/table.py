"""Table 1's third row (“robot writing”) as data: re-pressed strokes, their yardstick, and the model between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar

from pydantic import BaseModel, ConfigDict, Field

from calibrate.compare.field import Alignment, Tone
from calibrate.loop.images import KEYS
from calibrate.loop.scores import AGAIN, ANOTHER, SIMULATED, PairScore, Verdict, statistics
from calibrate.report.sealed import Sealed, load_sealed
from sessions.recording.schemas import Source

FILE = "loop.json"
FORMAT = "brushloop-loop-1"
MAX_BYTES = 8 * 1024 * 1024
Summed = tuple[float, float, float]
"""Max, min, avg in percent."""
PAPER_ROBOT: tuple[Summed, Summed] = ((98.21, 89.42, 93.31), (95.62, 85.85, 90.12))
"""CSIM, SSIM of “robot writing” in the CCD-BSMG paper's Table 1."""


class Table1Row(BaseModel):
    """Over the presses that were made again, in percent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: Source
    """`loopback rig` or `real capture`."""
    original: str
    again: str
    """Session ids."""
    model: str
    """What recovered depth and tilt."""
    what: str
    """`re-pressed`, `another press` or `recovered, simulated`."""
    alignment: Alignment
    tone: Tone
    n: Annotated[int, Field(ge=1)]
    csim: Summed
    ssim: Summed
    csim_median: float
    ssim_median: float
    paper_csim: Summed | None = None
    paper_ssim: Summed | None = None

    @property
    def numbers(self) -> tuple[float, ...]:
        """Max, min, avg and median of CSIM, then of SSIM."""
        return (*self.csim, self.csim_median, *self.ssim, self.ssim_median)


class LoopRecord(Sealed):
    """A closed loop as its `loop.json` holds it: everything but the images and the single scores."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop loop compare"

    format: str = FORMAT
    source: Source
    """Of the session that pressed again."""
    original: str
    original_sha256: str
    again: str
    again_sha256: str
    """Session ids, and of their recordings."""
    model: str
    in_sample: bool
    """Whether that model was fitted to the original presses themselves."""
    mm_per_px: float
    """Scale of the millimetre field."""
    pairs: int
    goal_points: float
    table_1: tuple[Table1Row, ...]
    verdicts: tuple[Verdict, ...]
    refused: tuple[tuple[str, str], ...]
    """(stroke, why)."""
    software: str
    command: str

    def row(self, what: str, alignment: Alignment, tone: Tone) -> Table1Row | None:
        """One row of the table, or None where nothing was compared so."""
        for one in self.table_1:
            if (one.what, one.alignment, one.tone) == (what, alignment, tone):
                return one
        return None


def table_1(scores: Sequence[PairScore], *, source: Source, original: str, again: str, model: str) -> list[Table1Row]:
    """The rows in the order of `KEYS`; the paper's stand beside the re-pressed ones."""
    rows: list[Table1Row] = []
    for alignment, tone in KEYS:
        for what in (AGAIN, ANOTHER, SIMULATED):
            c, s = (statistics(scores, what, alignment, tone, of) for of in ("csim", "ssim"))
            if c is None or s is None:
                continue
            rows.append(
                Table1Row(
                    source=source,
                    original=original,
                    again=again,
                    model=model,
                    what=what,
                    alignment=alignment,
                    tone=tone,
                    n=c.n,
                    csim=(c.max, c.min, c.avg),
                    ssim=(s.max, s.min, s.avg),
                    csim_median=c.median,
                    ssim_median=s.median,
                    paper_csim=PAPER_ROBOT[0] if what == AGAIN else None,
                    paper_ssim=PAPER_ROBOT[1] if what == AGAIN else None,
                )
            )
    return rows


def read_loop(path: Path) -> LoopRecord:
    """A `loop.json`, or the one in a loop's folder. Raises `CalibrationError` where it is none, or was edited."""
    return load_sealed(path / FILE if path.is_dir() else path, LoopRecord, MAX_BYTES)


def read_table_1(path: Path) -> list[Table1Row]:
    """The rows of `read_loop`."""
    return list(read_loop(path).table_1)
