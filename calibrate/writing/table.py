"""Table 3 of the CCD-BSMG paper as data: a row a character and comparison, the paper's numbers where they belong."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from calibrate.compare.field import Alignment, Tone
from calibrate.report.sealed import Sealed, load_sealed
from calibrate.writing.images import KEYS, Polarity
from calibrate.writing.scores import PAIRS, REFERENCE, SIMULATED, WrittenScore
from sessions.recording.schemas import Source

FILE, PICTURE = "written.json", "figure-13.png"
FORMAT = "brushloop-written-1"
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

    source: Source
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


class WrittenRecord(Sealed):
    """Written characters as their `written.json` holds them: everything but the images and the single scores."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop write compare"

    format: str = FORMAT
    source: Source
    session: str
    recording_sha256: str
    brush: str
    """As the recording names it."""
    model: str
    cell_mm: float
    table_3: tuple[Table3Row, ...]
    refused: tuple[tuple[str, str], ...]
    """(stroke, why)."""
    figure_13_sha256: str
    """Of the picture beside it."""
    software: str
    command: str

    @property
    def characters(self) -> tuple[str, ...]:
        """What was written, in the table's order."""
        return tuple(dict.fromkeys(row.character for row in self.table_3))


def table_3(
    scores: Iterable[WrittenScore], *, source: Source, session_id: str, model: str, references: dict[str, str]
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


def read_written(path: Path) -> WrittenRecord:
    """A `written.json`, or the one in a report's folder. Raises `CalibrationError` where it is none, or was edited."""
    return load_sealed(path / FILE if path.is_dir() else path, WrittenRecord, MAX_BYTES)


def read_table_3(path: Path) -> list[Table3Row]:
    """The rows of `read_written`."""
    return list(read_written(path).table_3)


def _summed(values: list[float]) -> Summed:
    return max(values), min(values), sum(values) / len(values)
