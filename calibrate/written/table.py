"""Table 3 of the CCD-BSMG paper as data: a row a character and comparison, the paper's numbers where they belong."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from calibrate.errors import CalibrationError
from calibrate.field import Alignment, Tone
from calibrate.files import read_bounded
from calibrate.written.images import KEYS, Polarity
from calibrate.written.scores import PAIRS, REFERENCE, SIMULATED, WrittenScore

FILE = "written.json"
MAX_BYTES = 8 * 1024 * 1024
Summed = tuple[float, float, float]
"""Max, min, avg in percent."""
PAPER_TABLE_3: dict[str, tuple[str, Summed, Summed]] = {
    SIMULATED: ("CCD-BSMG", (97.71, 91.45, 94.58), (79.26, 72.56, 75.91)),
    REFERENCE: ("robot writing", (95.82, 91.36, 93.59), (78.78, 70.42, 74.60)),
}
"""Comparison -> (the paper's row, CSIM, SSIM). Which of its rows stands beside which of ours is our reading: the paper
does not say what each was compared with, nor whether it wrote 字 or 子, nor its polarity."""


class Table3Row(BaseModel):
    """Max, min, avg and median over the writings of one character, in percent."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
    """`loopback rig` or `real capture`."""
    session_id: str
    character: str
    reference: str
    """The font, or the user's picture."""
    model: str
    pair: str
    """What was compared with what."""
    alignment: Alignment
    tone: Tone
    polarity: Polarity
    n: Annotated[int, Field(ge=1)]
    csim: Summed
    ssim: Summed
    csim_median: float
    ssim_median: float
    paper_row: str | None = None
    paper_csim: Summed | None = None
    paper_ssim: Summed | None = None


def table_3(
    scores: Iterable[WrittenScore], *, source: str, session_id: str, model: str, references: dict[str, str]
) -> list[Table3Row]:
    """The rows, by character, then in the order of `KEYS` and `PAIRS`; `references` name each character's reference."""
    grouped: dict[tuple[str, Alignment, Tone, Polarity, str], list[WrittenScore]] = {}
    for s in scores:
        grouped.setdefault((s.character, s.alignment, s.tone, s.polarity, s.pair), []).append(s)
    rows: list[Table3Row] = []
    for character, reference in references.items():
        for key in KEYS:
            for pair in PAIRS:
                found = grouped.get((character, *key, pair))
                if not found:
                    continue
                paper = PAPER_TABLE_3.get(pair)
                csims, ssims = ([100.0 * getattr(s, of) for s in found] for of in ("csim", "ssim"))
                rows.append(
                    Table3Row(
                        source=source,
                        session_id=session_id,
                        character=character,
                        reference=reference,
                        model=model,
                        pair=pair,
                        alignment=key[0],
                        tone=key[1],
                        polarity=key[2],
                        n=len(found),
                        csim=_summed(csims),
                        ssim=_summed(ssims),
                        csim_median=float(np.median(csims)),
                        ssim_median=float(np.median(ssims)),
                        paper_row=paper[0] if paper else None,
                        paper_csim=paper[1] if paper else None,
                        paper_ssim=paper[2] if paper else None,
                    )
                )
    return rows


def read_table_3(path: Path) -> list[Table3Row]:
    """The rows of a `written.json`, or of the one in a report's folder. Raises `CalibrationError`."""
    path = path / FILE if path.is_dir() else path
    data = read_bounded(path, MAX_BYTES)
    try:
        told: Any = json.loads(data)
        return [Table3Row.model_validate(row) for row in told["table_3"]]
    except (ValidationError, ValueError, KeyError, TypeError, RecursionError):
        raise CalibrationError(str(path), "holds no Table 3: write it with `brushloop write compare`") from None


def _summed(values: list[float]) -> Summed:
    return max(values), min(values), sum(values) / len(values)
