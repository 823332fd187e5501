"""Similarity of a press and its repetition, against that of two presses of one condition: Table 1's third row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare.paper import ROBOT_WRITING, TABLE_1, Triple
from brushloop.calibrate.compare.place import KEYS, Alignment, Image, Key, Tone
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.presses import Press
from brushloop.calibrate.report import Sealed, load_sealed
from brushloop.calibrate.stats import interval_over_groups
from brushloop.sessions.records import Condition, Source

FILE = "loop.json"
FORMAT = "brushloop-loop-1"
MAX_BYTES = 8 * 1024 * 1024
AGAIN, SIMULATED, ANOTHER = "re-pressed", "recovered, simulated", "another press"
"""What is compared with an original: its repetition, the model's image of it, other originals of its condition."""
GOAL_POINTS = 1.0
"""Points by which re-pressed strokes may score below the originals' own repeatability."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A stroke and its repetition. Depth and tilt of `original` are as commanded, those of `again` as recovered."""

    original: Press
    again: Press
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
    """95 % interval over the commanded conditions; None with fewer than three."""
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
        rows = (row for row in self.table_1 if (row.what, row.alignment, row.tone) == (what, alignment, tone))
        return next(rows, None)


def read_loop(path: Path) -> LoopRecord:
    """Read a `loop.json`, or the one in a loop's folder. Raises `CalibrationError` if it is invalid or was edited."""
    return load_sealed(path / FILE if path.is_dir() else path, LoopRecord, MAX_BYTES)


def score_pairs(pairs: Sequence[Pair], originals: Iterable[Press]) -> list[PairScore]:
    """Score repetition, simulation and other presses of the condition against each original that was pressed again."""
    alike: dict[Condition, list[Press]] = {}
    for press in originals:
        alike.setdefault(press.condition, []).append(press)
    scores: list[PairScore] = []
    for pair in pairs:
        original = pair.original
        others = [press for press in alike[original.condition] if press is not original]
        for key in KEYS:
            against = {AGAIN: [pair.again.images[key]], SIMULATED: [pair.simulated[key]]}
            against[ANOTHER] = [press.images[key] for press in others]
            for what, images in against.items():
                if images:
                    of_each = [similarity(original.images[key], image, key[0]) for image in images]
                    csim, ssim = np.mean(of_each, axis=0).tolist()
                    names = original.stroke.stroke_id, pair.again.stroke.stroke_id
                    scores.append(PairScore(*names, original.condition, what, *key, csim, ssim))
    return scores


def scores_of(scores: Sequence[PairScore], what: str, key: Key) -> list[PairScore]:
    """The scores of one kind of comparison, in one alignment and tone."""
    return [score for score in scores if (score.what, score.alignment, score.tone) == (what, *key)]


def table_1(scores: Sequence[PairScore], *, source: Source, original: str, again: str, model: str) -> list[Table1Row]:
    """Rows in the order of `KEYS`; rows of re-pressed strokes also have the paper's numbers."""
    paper = TABLE_1[ROBOT_WRITING]
    rows: list[Table1Row] = []
    for key in KEYS:
        for what in (AGAIN, ANOTHER, SIMULATED):
            percent = 100.0 * np.array([(score.csim, score.ssim) for score in scores_of(scores, what, key)])
            if not len(percent):
                continue
            csim, ssim = percent.T
            rows.append(
                Table1Row(
                    source=source,
                    original=original,
                    again=again,
                    model=model,
                    what=what,
                    alignment=key[0],
                    tone=key[1],
                    n=len(percent),
                    csim=_triple(csim),
                    ssim=_triple(ssim),
                    csim_median=float(np.median(csim)),
                    ssim_median=float(np.median(ssim)),
                    paper_csim=paper.csim if what == AGAIN else None,
                    paper_ssim=paper.ssim if what == AGAIN else None,
                )
            )
    return rows


def _triple(values: NDArray[np.float64]) -> Triple:
    """Max, min and average, in the order of the paper's tables."""
    return float(values.max()), float(values.min()), float(values.mean())


def verdicts(scores: Sequence[PairScore]) -> list[Verdict]:
    """Verdicts for each alignment, tone and measure; empty if no condition was pressed twice."""
    return [
        verdict
        for key in KEYS
        for measure in ("csim", "ssim")
        if (verdict := _verdict(scores, key, measure)) is not None
    ]


def _verdict(scores: Sequence[PairScore], key: Key, measure: str) -> Verdict | None:
    again, another = (
        {score.again: 100.0 * getattr(score, measure) for score in scores_of(scores, what, key)}
        for what in (AGAIN, ANOTHER)
    )
    both = [name for name in again if name in another]
    if not both:
        return None
    condition = {score.again: score.condition for score in scores}
    conditions = sorted({condition[name] for name in both})
    differences = np.array([again[name] - another[name] for name in both])
    group = np.array([conditions.index(condition[name]) for name in both])
    low, high = interval_over_groups(differences, group) or (None, None)
    of_again, of_another = (float(np.mean([values[name] for name in both])) for values in (again, another))
    difference = float(differences.mean())
    holds = difference >= -GOAL_POINTS
    return Verdict(*key, measure, of_again, of_another, difference, low, high, len(both), holds)
