"""Similarity of a press and its repetition, against that of two presses of one cell: data of Table 1's third row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare.paper import ROBOT_WRITING, TABLE_1, Triple
from brushloop.calibrate.compare.place import KEYS, Alignment, Image, Key, Tone
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.report import Sealed, load_sealed
from brushloop.calibrate.stats import Summary, interval_over_groups, summarise
from brushloop.calibrate.stroke.measure import Measured
from brushloop.sessions.records import Condition, Source

FILE = "loop.json"
FORMAT = "brushloop-loop-1"
MAX_BYTES = 8 * 1024 * 1024
AGAIN, SIMULATED, ANOTHER = "re-pressed", "recovered, simulated", "another press"
"""What is compared with an original: its repetition, the model's image of it, other originals of the same cell."""
GOAL_POINTS = 1.0
"""Points by which re-pressed strokes may score below the originals' own repeatability."""


@dataclass(frozen=True, slots=True)
class CapturedPress:
    """A press that can be compared."""

    stroke_id: str
    condition: Condition
    """As commanded."""
    measured: Measured
    images: dict[Key, Image]
    """(128, 128) each."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A stroke and its repetition. Depth and tilt of `original` are as commanded, those of `again` as recovered."""

    original: CapturedPress
    again: CapturedPress
    simulated: dict[Key, Image]
    """The model's press at the recovered depth and tilt, (128, 128) each."""


@dataclass(frozen=True, slots=True)
class PairScore:
    """Scores of one comparison with an original."""

    original: str
    again: str
    condition: Condition
    """As commanded for the original."""
    what: str
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Score of re-pressed minus another press, over the originals that have both, in points (percent)."""

    alignment: Alignment
    tone: Tone
    measure: str
    """`csim` or `ssim`."""
    again: float
    another: float
    difference: float
    low: float | None
    high: float | None
    """95 % interval over the commanded cells; None with fewer than three."""
    n: int
    holds: bool
    """Whether the difference is at least minus `GOAL_POINTS`."""

    @property
    def certain(self) -> bool:
        """Whether the whole interval lies on the same side of the limit."""
        bound = self.low if self.holds else self.high
        return bound is not None and (bound >= -GOAL_POINTS) == self.holds


class Table1Row(Frozen):
    """Statistics over the presses that were pressed again, in percent."""

    source: Source
    """`loopback rig` or `real capture`."""
    original: str
    again: str
    """Session ids."""
    model: str
    """Model that recovered depth and tilt."""
    what: str
    """`re-pressed`, `another press` or `recovered, simulated`."""
    alignment: Alignment
    tone: Tone
    n: Annotated[int, Field(ge=1)]
    csim: Triple
    ssim: Triple
    csim_median: float
    ssim_median: float
    paper_csim: Triple | None = None
    paper_ssim: Triple | None = None

    @property
    def numbers(self) -> tuple[float, ...]:
        """Max, min, avg and median of CSIM, then of SSIM."""
        return (*self.csim, self.csim_median, *self.ssim, self.ssim_median)


class LoopRecord(Sealed):
    """A closed loop as stored in `loop.json`: everything but the images and the individual scores."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop loop compare"

    format: str = FORMAT
    source: Source
    """Kind of ink of the session that pressed again."""
    original: str
    original_sha256: str
    again: str
    again_sha256: str
    """Session ids, and the SHA-256 of each recording."""
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
        """One row of the table, or None if nothing was compared in this way."""
        for one in self.table_1:
            if (one.what, one.alignment, one.tone) == (what, alignment, tone):
                return one
        return None


def read_loop(path: Path) -> LoopRecord:
    """Read a `loop.json`, or the one in a loop's folder. Raises `CalibrationError` if it is invalid or was edited."""
    return load_sealed(path / FILE if path.is_dir() else path, LoopRecord, MAX_BYTES)


def score_pairs(pairs: Sequence[Pair], originals: Iterable[CapturedPress]) -> list[PairScore]:
    """Score repetition, simulation and other presses of the cell against each original that was pressed again."""
    cells: dict[Condition, list[CapturedPress]] = {}
    for press in originals:
        cells.setdefault(press.condition, []).append(press)
    scores: list[PairScore] = []
    for pair in pairs:
        others = [one for one in cells[pair.original.condition] if one is not pair.original]
        for key in KEYS:
            against = {AGAIN: [pair.again.images[key]], SIMULATED: [pair.simulated[key]]}
            against[ANOTHER] = [one.images[key] for one in others]
            scores += [_score(pair, what, key, images) for what, images in against.items() if images]
    return scores


def _score(pair: Pair, what: str, key: Key, images: list[Image]) -> PairScore:
    alignment, tone = key
    original = pair.original
    csim, ssim = np.mean([similarity(original.images[key], image, alignment) for image in images], axis=0)
    return PairScore(
        original.stroke_id, pair.again.stroke_id, original.condition, what, alignment, tone, float(csim), float(ssim)
    )


def summary_of(scores: Sequence[PairScore], what: str, key: Key, measure: str) -> Summary | None:
    """Summarise `csim` or `ssim` in percent; None if there is no such score."""
    found = [getattr(s, measure) for s in scores if (s.what, s.alignment, s.tone) == (what, *key)]
    return summarise(100.0 * np.asarray(found))


def table_1(scores: Sequence[PairScore], *, source: Source, original: str, again: str, model: str) -> list[Table1Row]:
    """Rows in the order of `KEYS`; rows of re-pressed strokes also have the paper's numbers."""
    paper = TABLE_1[ROBOT_WRITING]
    rows: list[Table1Row] = []
    for key in KEYS:
        for what in (AGAIN, ANOTHER, SIMULATED):
            csim, ssim = (summary_of(scores, what, key, measure) for measure in ("csim", "ssim"))
            if csim is None or ssim is None:
                continue
            rows.append(
                Table1Row(
                    source=source,
                    original=original,
                    again=again,
                    model=model,
                    what=what,
                    alignment=key[0],
                    tone=key[1],
                    n=csim.n,
                    csim=csim.range_and_avg,
                    ssim=ssim.range_and_avg,
                    csim_median=csim.median,
                    ssim_median=ssim.median,
                    paper_csim=paper.csim if what == AGAIN else None,
                    paper_ssim=paper.ssim if what == AGAIN else None,
                )
            )
    return rows


def verdicts(scores: Sequence[PairScore]) -> list[Verdict]:
    """Verdicts for each alignment, tone and measure; empty if no cell was pressed twice."""
    return [found for key in KEYS for of in ("csim", "ssim") if (found := _verdict(scores, key, of)) is not None]


def _verdict(scores: Sequence[PairScore], key: Key, measure: str) -> Verdict | None:
    def percent(what: str) -> dict[str, float]:
        chosen = (s for s in scores if (s.what, s.alignment, s.tone) == (what, *key))
        return {s.again: 100.0 * getattr(s, measure) for s in chosen}

    again, another = percent(AGAIN), percent(ANOTHER)
    both = [name for name in again if name in another]
    if not both:
        return None
    cell_of = {s.again: s.condition for s in scores}
    cells = sorted({cell_of[name] for name in both})
    differences = np.array([again[name] - another[name] for name in both])
    difference = float(differences.mean())
    low, high = interval_over_groups(differences, np.array([cells.index(cell_of[n]) for n in both])) or (None, None)
    ours, theirs = (float(np.mean([values[name] for name in both])) for values in (again, another))
    return Verdict(*key, measure, ours, theirs, difference, low, high, len(both), difference >= -GOAL_POINTS)
