"""How alike a press and its repetition are, beside how alike the brush makes any two presses of one (H, alpha)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.compare.field import Alignment, Image, Tone
from calibrate.loop.images import KEYS, Seen, similarity
from calibrate.loop.pairs import Pair, Paired

AGAIN, SIMULATED, ANOTHER = "re-pressed", "recovered, simulated", "another press"
"""The contestants: the repetition, the model's image of it, and each other original of the same commanded cell."""
GOAL_POINTS = 1.0
"""By how much the re-pressed strokes may score less than the originals' own repeatability."""
DRAWS, SEED = 2000, 0
LEAST_CELLS = 3


@dataclass(frozen=True, slots=True)
class PairScore:
    """One contestant against one original."""

    original: str
    again: str
    cell: tuple[float, float]
    """H and alpha as commanded for the original."""
    what: str
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float


@dataclass(frozen=True, slots=True)
class Statistics:
    """In percent."""

    n: int
    max: float
    min: float
    avg: float
    median: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """Re-pressed minus another press, over the originals that have both, in points (percent)."""

    alignment: Alignment
    tone: Tone
    measure: str
    """`csim` or `ssim`."""
    again: float
    another: float
    difference: float
    low: float | None
    high: float | None
    """95 % interval, by bootstrap over the commanded cells; None with fewer than three."""
    n: int
    holds: bool
    """Whether the difference is at least minus `GOAL_POINTS`."""

    @property
    def certain(self) -> bool:
        """Whether the whole interval says the same."""
        bound = self.low if self.holds else self.high
        return bound is not None and (bound >= -GOAL_POINTS) == self.holds


def score_pairs(paired: Paired) -> list[PairScore]:
    """Every contestant against every original that was pressed again, in each alignment and tone."""
    cells: dict[tuple[float, float], list[Seen]] = {}
    for stroke in paired.originals.values():
        cells.setdefault((stroke.height_mm, stroke.tilt_deg), []).append(stroke)
    out: list[PairScore] = []
    for pair in paired.pairs:
        cell = (pair.original.height_mm, pair.original.tilt_deg)
        others = [one for one in cells[cell] if one is not pair.original]
        for key in KEYS:
            against = {AGAIN: [pair.again.images[key]], SIMULATED: [pair.simulated[key]]}
            against[ANOTHER] = [one.images[key] for one in others]
            out += [_score(pair, cell, what, key, images) for what, images in against.items() if images]
    return out


def statistics(scores: Sequence[PairScore], what: str, alignment: Alignment, tone: Tone, of: str) -> Statistics | None:
    """Of `csim` or `ssim`; None where there is no such score."""
    found = [getattr(s, of) for s in scores if (s.what, s.alignment, s.tone) == (what, alignment, tone)]
    if not found:
        return None
    percent = 100.0 * np.asarray(found)
    most, least, mean = float(percent.max()), float(percent.min()), float(percent.mean())
    return Statistics(len(found), most, least, mean, float(np.median(percent)))


def verdicts(scores: Sequence[PairScore]) -> list[Verdict]:
    """One for each alignment, tone and measure; none where no cell was pressed twice."""
    return [made for key in KEYS for of in ("csim", "ssim") if (made := _verdict(scores, *key, of)) is not None]


def _score(
    pair: Pair, cell: tuple[float, float], what: str, key: tuple[Alignment, Tone], images: list[Image]
) -> PairScore:
    found = np.mean([similarity(pair.original.images[key], image, key[0]) for image in images], axis=0)
    alignment, tone = key
    original, again = pair.original.stroke_id, pair.again.stroke_id
    return PairScore(original, again, cell, what, alignment, tone, float(found[0]), float(found[1]))


def _verdict(scores: Sequence[PairScore], alignment: Alignment, tone: Tone, of: str) -> Verdict | None:
    def values(what: str) -> dict[str, tuple[tuple[float, float], float]]:
        chosen = (s for s in scores if (s.what, s.alignment, s.tone) == (what, alignment, tone))
        return {s.again: (s.cell, 100.0 * getattr(s, of)) for s in chosen}

    again, another = values(AGAIN), values(ANOTHER)
    both = [name for name in again if name in another]
    if not both:
        return None
    cells: dict[tuple[float, float], list[float]] = {}
    for name in both:
        cells.setdefault(again[name][0], []).append(again[name][1] - another[name][1])
    difference = float(np.mean([value for cell in cells.values() for value in cell]))
    low, high = bootstrap(list(cells.values()))
    ours, theirs = (float(np.mean([table[name][1] for name in both])) for table in (again, another))
    return Verdict(alignment, tone, of, ours, theirs, difference, low, high, len(both), difference >= -GOAL_POINTS)


def bootstrap(groups: Sequence[Sequence[float]]) -> tuple[float | None, float | None]:
    """95 % interval of the mean of all values, whole groups drawn with replacement; (None, None) for too few groups."""
    if len(groups) < LEAST_CELLS:
        return None, None
    sums, counts = np.array([sum(group) for group in groups]), np.array([len(group) for group in groups])
    drawn = np.random.default_rng(SEED).integers(len(groups), size=(DRAWS, len(groups)))
    low, high = np.percentile(sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1), [2.5, 97.5])
    return float(low), float(high)
