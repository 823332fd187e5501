"""CAN frames of the force sensor: any frames at any times give plausible wrenches or nothing, and the next round."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Iterator

from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.force.rounds import FIRST_ID, RoundAssembler, encode_round
from tests.drivers.fuzz.inputs import EXAMPLES, LEAST_INPUTS

Frame = tuple[int, bytes, float]

MAX_N, MAX_NM, ROUND_MS = 1000.0, 100.0, 5.0
TIMES = st.floats(allow_nan=True, allow_infinity=True)
FRAMES = st.tuples(st.integers(0x28F, 0x295) | st.integers(), st.binary(max_size=9), TIMES)


def plausible_until_the_end(frames: Iterable[Frame]) -> int:
    """How many wrenches a fresh assembler makes of the frames; a sound round after them must come through."""
    parts = RoundAssembler(round_ms=ROUND_MS, max_n=MAX_N, max_nm=MAX_NM)
    whole = 0
    for can_id, data, at_s in frames:
        wrench = parts.feed(can_id, data, at_s)
        if wrench is not None:
            assert can_id == FIRST_ID + 2, "the last frame completes a round"
            assert all(math.isfinite(v) and abs(v) <= MAX_N for v in wrench)
            whole += 1
        assert len(parts._values) <= 4, "no more than two frames wait for the third"
    sound = (1.0, -2.0, 3.5, 0.25, -0.5, 0.125)
    assert [parts.feed(can_id, data, 7.0) for can_id, data in encode_round(sound)] == [None, None, sound]
    return whole


def injured(rounds: int, rng: random.Random) -> Iterator[Frame]:
    """A stream of rounds of which some frames are lost, doubled, swapped, cut, late, or say what none could measure."""
    frames: list[Frame] = []
    for number in range(rounds):
        wrench = [rng.choice((rng.uniform(-9, 9), math.nan, math.inf, 3e38)) if rng.random() < 0.1 else 1.0] * 6
        frames += [(can_id, data, number * 0.01) for can_id, data in encode_round(tuple(wrench))]  # pyright: ignore
    for at in range(len(frames)):
        can_id, data, at_s = frames[at]
        match rng.randrange(12):
            case 0:
                continue
            case 1:
                yield frames[at]
            case 2:
                data = data[: rng.randint(0, 8)] + rng.randbytes(rng.randint(0, 2))
            case 3:
                at_s += rng.choice((-1.0, 0.006, 1e9, math.nan, math.inf))
            case 4:
                can_id = rng.randint(0x290, 0x294)
            case _:
                pass
        yield can_id, data, at_s


def test_any_frames_give_plausible_wrenches_or_nothing():
    inputs = whole = 0

    @settings(EXAMPLES, max_examples=150)
    @given(st.lists(FRAMES, max_size=30))
    def anything(frames: list[Frame]) -> None:
        nonlocal inputs
        plausible_until_the_end(frames)
        inputs += len(frames)

    anything()
    rng = random.Random(21)
    for _ in range(500):
        frames = list(injured(10, rng))
        whole += plausible_until_the_end(frames)
        inputs += len(frames)
    assert inputs >= LEAST_INPUTS
    assert whole > 1000


def test_rounds_of_different_times_are_never_mixed():
    rng = random.Random(22)
    for _ in range(2000):
        parts = RoundAssembler(round_ms=ROUND_MS, max_n=MAX_N, max_nm=MAX_NM)
        for number in range(5):
            for can_id, data in encode_round((float(number),) * 6):
                if rng.random() < 0.3:
                    continue
                wrench = parts.feed(can_id, data, number * 0.01)
                assert wrench is None or set(wrench) == {float(number)}
