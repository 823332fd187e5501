"""Table 1's third row (“robot writing”) as data: re-pressed strokes, their yardstick, and the model between them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibrate.errors import CalibrationError
from calibrate.field import Alignment, Tone
from calibrate.files import read_bounded
from calibrate.loop.images import KEYS
from calibrate.loop.scores import AGAIN, ANOTHER, SIMULATED, PairScore, statistics

FILE = "loop.json"
Summed = tuple[float, float, float]
"""Max, min, avg in percent."""
PAPER_ROBOT: tuple[Summed, Summed] = ((98.21, 89.42, 93.31), (95.62, 85.85, 90.12))
"""CSIM, SSIM of “robot writing” in the CCD-BSMG paper's Table 1."""


class Table1Row(BaseModel):
    """Over the presses that were made again, in percent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
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


def table_1(scores: Sequence[PairScore], *, source: str, original: str, again: str, model: str) -> list[Table1Row]:
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


def read_table_1(path: Path) -> list[Table1Row]:
    """The rows of a `loop.json`, or of the one in a loop's folder. Raises `CalibrationError`."""
    path = path / FILE if path.is_dir() else path
    data = read_bounded(path)
    try:
        told: Any = json.loads(data)
        return [Table1Row.model_validate(row) for row in told["table_1"]]
    except (ValidationError, ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(str(path), "holds no Table 1: write it with `brushloop loop compare`") from None
