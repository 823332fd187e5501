from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.drivers.force.rounds import RoundAssembler, Wrench, encode_round

THOROUGH = settings(max_examples=10 * settings.default.max_examples, deadline=None)
SOME = settings(max_examples=100, deadline=None)
WRENCH: Wrench = (1.0, -2.0, 3.5, 0.25, -0.5, 0.125)
FLOATS = st.floats(-100.0, 100.0, width=32)


def assembler(round_ms: float = 5.0) -> RoundAssembler:
    return RoundAssembler(round_ms=round_ms, max_n=1000.0, max_nm=100.0)


def feed(parts: RoundAssembler, wrench: Wrench, leave_out: int | None = None, at_s: float = 0.0) -> list[Wrench]:
    frames = [frame for place, frame in enumerate(encode_round(wrench)) if place != leave_out]
    return [whole for can_id, data in frames if (whole := parts.feed(can_id, data, at_s)) is not None]


def test_a_round_is_three_frames_of_two_floats_low_byte_first():
    assert [(hex(can_id), data.hex(" ")) for can_id, data in encode_round(WRENCH)] == [
        ("0x291", "00 00 80 3f 00 00 00 c0"),
        ("0x292", "00 00 60 40 00 00 80 3e"),
        ("0x293", "00 00 00 bf 00 00 00 3e"),
    ]


@SOME
@given(st.tuples(*[FLOATS] * 6))
def test_a_round_comes_back(wrench: Wrench):
    parts = assembler()
    assert feed(parts, wrench) == [wrench]
    assert (parts.torn, parts.refused) == (0, 0)


@pytest.mark.parametrize("leave_out", [0, 1, 2])
def test_a_round_without_one_frame_is_dropped_and_counted_once(leave_out: int):
    parts = assembler()
    assert feed(parts, WRENCH) == [WRENCH]
    assert feed(parts, WRENCH, leave_out) == []
    assert feed(parts, WRENCH) == [WRENCH]
    assert parts.torn == 1


@pytest.mark.parametrize("leave_out", [0, 1, 2])
def test_each_of_many_torn_rounds_is_counted(leave_out: int):
    parts = assembler()
    feed(parts, WRENCH)
    for _ in range(5):
        assert feed(parts, WRENCH, leave_out) == []
    assert feed(parts, WRENCH) == [WRENCH]
    assert parts.torn == 5


@pytest.mark.parametrize("first", [1, 2])
def test_joining_in_mid_round_is_no_fault(first: int):
    parts = assembler()
    assert [parts.feed(can_id, data, 0.0) for can_id, data in encode_round(WRENCH)[first:]] == [None] * (3 - first)
    assert feed(parts, WRENCH) == [WRENCH]
    assert parts.torn == 0


def test_two_halves_of_different_rounds_do_not_make_one():
    parts = assembler()
    old, new = encode_round(WRENCH), encode_round((9.0,) * 6)
    assert parts.feed(*old[0], 1.000) is None
    assert parts.feed(*new[1], 1.010) is None
    assert parts.feed(*new[2], 1.010) is None
    assert parts.torn == 2


@pytest.mark.parametrize("size", [0, 4, 7])
def test_a_frame_of_the_wrong_size_tears_its_round(size: int):
    parts = assembler()
    frames = [
        (can_id, data[:size] if place == 1 else data) for place, (can_id, data) in enumerate(encode_round(WRENCH))
    ]
    assert [parts.feed(can_id, data, 0.0) for can_id, data in frames] == [None] * 3
    assert parts.torn == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 3e38, -1000.5])
@pytest.mark.parametrize("axis", range(6))
def test_what_no_sensor_can_measure_is_refused(axis: int, bad: float):
    values = list(WRENCH)
    values[axis] = bad
    parts = assembler()
    assert feed(parts, tuple(values)) == []
    assert (parts.torn, parts.refused) == (0, 1)
    assert feed(parts, WRENCH) == [WRENCH]


@SOME
@given(st.lists(st.tuples(st.integers(0x290, 0x294), st.binary(max_size=9), st.floats(allow_nan=True)), max_size=12))
def test_any_frames_give_plausible_wrenches_or_nothing(frames: list[tuple[int, bytes, float]]):
    parts = assembler()
    for frame in frames:
        wrench = parts.feed(*frame)
        assert wrench is None or all(math.isfinite(v) and abs(v) <= 1000.0 for v in wrench)
    assert feed(parts, WRENCH, at_s=0.0) == [WRENCH]


@SOME
@given(st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=20))
def test_with_frames_lost_at_random_every_wrench_is_of_one_round(kept: list[tuple[bool, bool, bool]]):
    parts, whole = assembler(), 0
    for number, keeps in enumerate(kept):
        for keep, frame in zip(keeps, encode_round((float(number),) * 6), strict=True):
            wrench = parts.feed(*frame, number * 0.010) if keep else None
            if wrench is not None:
                assert set(wrench) == {float(number)}
                whole += 1
    assert whole == kept.count((True, True, True))
    assert parts.torn <= sum(any(keeps) and not all(keeps) for keeps in kept)


@THOROUGH
@given(st.binary(min_size=24, max_size=24))
def test_any_payload_is_a_wrench_or_refused(data: bytes):
    parts = assembler()
    found = [parts.feed(0x291 + place, data[8 * place : 8 * place + 8], 0.0) for place in range(3)]
    values = struct.unpack("<6f", data)
    limits = (1000.0,) * 3 + (100.0,) * 3
    plausible = all(abs(v) <= limit for v, limit in zip(values, limits, strict=True))
    assert found[2] == (values if plausible else None)
    assert parts.refused == (not plausible)
