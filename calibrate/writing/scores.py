"""How alike a written character is to its simulated image, to its reference, and to its own other writings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.compare.field import Alignment, Image, Tone
from calibrate.writing.images import KEYS, Ink, Key, Polarity, similarity

SIMULATED, REFERENCE = "captured, simulated", "captured, reference"
PLANNED, ANOTHER = "simulated, reference", "captured, another writing"
PAIRS = (SIMULATED, REFERENCE, PLANNED, ANOTHER)
"""What is compared with what."""
MOST_OTHERS = 12
"""Other writings that one is compared with: a hundred writings would make ten thousand pairs."""


@dataclass(frozen=True, slots=True)
class Character:
    """One character: what was wanted, what the model makes of the plan, and what was written."""

    name: str
    reference_name: str
    reference: Ink
    simulated: Ink
    captured: dict[str, Ink]
    """By stroke id."""
    cut: tuple[str, ...] = ()
    """Writings whose ink reaches the edge of their cell."""

    def mean_ink(self) -> Image:
        """(128, 128) share of the writings that inked each place."""
        return np.asarray(np.mean([ink[Tone.BINARY] for ink in self.captured.values()], axis=0), np.float32)


@dataclass(frozen=True, slots=True)
class WrittenScore:
    """One comparison; `stroke_id` is empty where no writing takes part."""

    character: str
    stroke_id: str
    pair: str
    alignment: Alignment
    tone: Tone
    polarity: Polarity
    csim: float
    ssim: float


def score_character(one: Character) -> Iterator[WrittenScore]:
    """Every writing in every alignment, tone and polarity; another writing is the mean over the others."""
    for key in KEYS:
        yield _score(one, "", PLANNED, key, one.reference, [one.simulated])
        for stroke_id, ink in one.captured.items():
            yield _score(one, stroke_id, SIMULATED, key, ink, [one.simulated])
            yield _score(one, stroke_id, REFERENCE, key, one.reference, [ink])
            if others := _others(one, stroke_id):
                yield _score(one, stroke_id, ANOTHER, key, ink, others)


def _others(one: Character, stroke_id: str) -> list[Ink]:
    """The next `MOST_OTHERS` writings, the last followed by the first."""
    names = list(one.captured)
    place = names.index(stroke_id)
    following = (names[place + 1 :] + names[:place])[:MOST_OTHERS]
    return [one.captured[name] for name in following]


def _score(one: Character, stroke_id: str, pair: str, key: Key, fixed: Ink, others: Sequence[Ink]) -> WrittenScore:
    found = np.mean([similarity(fixed, other, key) for other in others], axis=0)
    alignment, tone, polarity = key
    return WrittenScore(one.name, stroke_id, pair, alignment, tone, polarity, float(found[0]), float(found[1]))
