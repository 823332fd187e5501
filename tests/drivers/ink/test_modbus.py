from __future__ import annotations

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.ink.pump import exception, find_reply, read_write, seal, unseal, write_register
from brushloop.drivers.sim.instruments.ink import PumpFirmware

THOROUGH = settings(max_examples=10 * settings.default.max_examples, deadline=None)
SOME = settings(max_examples=100, deadline=None)
WORDS = st.integers(0, 0xFFFF)
START = write_register(1, 4, 1)


@pytest.mark.parametrize(
    ("register", "value", "frame"),
    [
        (1, 5000, "01 06 00 01 13 88 D5 5C"),
        (4, 1, "01 06 00 04 00 01 09 CB"),
        (4, 0, "01 06 00 04 00 00 C8 0B"),
        (4, 2, "01 06 00 04 00 02 49 CA"),
    ],
)
def test_frames_are_the_published_ones(register: int, value: int, frame: str):
    assert write_register(1, register, value) == bytes.fromhex(frame)


@SOME
@given(st.integers(1, 247), WORDS, WORDS)
def test_a_write_comes_back(unit: int, register: int, value: int):
    assert read_write(write_register(unit, register, value)) == (unit, register, value)


@pytest.mark.parametrize(
    ("unit", "register", "value"), [(0, 1, 1), (248, 1, 1), (1, -1, 1), (1, 0x10000, 1), (1, 1, -1)]
)
def test_what_does_not_fit_is_not_sent(unit: int, register: int, value: int):
    with pytest.raises(ValueError, match="do not fit"):
        write_register(unit, register, value)


@THOROUGH
@given(st.one_of(st.binary(max_size=20), st.binary(max_size=12).map(seal)))
@example(b"")
def test_any_bytes_are_a_frame_or_a_protocol_violation(data: bytes):
    for read in (unseal, read_write):
        try:
            read(data)
        except ProtocolViolation:
            continue
        assert seal(data[:-2]) == data


@THOROUGH
@given(st.one_of(st.binary(max_size=40), st.binary(max_size=8).map(lambda noise: noise + START)))
def test_any_bytes_hold_a_confirmation_an_exception_or_neither(data: bytes):
    found = find_reply(data, START)
    assert found is None or 0 <= found <= 255
    assert (found == 0) <= (START in data)


@SOME
@given(st.binary(max_size=30), st.integers(1, 255), st.integers(1, 5))
def test_an_exception_is_found_after_any_noise_and_not_before_it_is_whole(noise: bytes, code: int, missing: int):
    whole = noise + exception(1, 6, code)
    if find_reply(noise, START) is None:
        assert find_reply(whole, START) == code
        assert find_reply(whole[:-missing], START) in (None, find_reply(noise, START))


@SOME
@given(st.data())
def test_one_bit_changed_is_never_a_confirmation(data: st.DataObject):
    bit = data.draw(st.integers(0, 63))
    damaged = bytearray(START)
    damaged[bit // 8] ^= 1 << bit % 8
    assert find_reply(bytes(damaged), START) is None


def test_confirmations_of_other_units_registers_and_values_are_passed_over():
    others = write_register(2, 4, 1) + write_register(1, 1, 1) + write_register(1, 4, 0) + exception(2, 6, 2)
    assert find_reply(others, START) is None
    assert find_reply(others + START, START) == 0


def test_exception_code_zero_is_not_a_confirmation():
    assert find_reply(exception(1, 6, 0), START) is None


@SOME
@given(st.one_of(st.binary(max_size=40), st.lists(st.binary(min_size=6, max_size=6).map(seal)).map(b"".join)))
def test_the_simulated_pump_survives_any_bytes(data: bytes):
    firmware = PumpFirmware()
    buffer = bytearray(data)
    while (request := firmware.take(buffer)) is not None:
        firmware.answer(request)
    assert len(buffer) < 8
    assert 0.0 <= firmware.rpm <= 600.0


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (seal(bytes.fromhex("01 03 00 01 00 01")), 1),
        (write_register(1, 2, 1), 2),
        (write_register(1, 4, 3), 3),
        (write_register(1, 1, 60001), 3),
    ],
)
def test_the_simulated_pump_answers_with_exceptions(request_: bytes, code: int):
    assert PumpFirmware().answer(request_) == exception(1, request_[1], code)


def test_the_simulated_pump_pumps_by_the_clock():
    now_s = 0.0
    firmware = PumpFirmware(ml_per_revolution=0.5, now_s=lambda: now_s)
    firmware.answer(write_register(1, 1, 6000))
    firmware.answer(START)
    now_s = 10.0
    assert firmware.pumped_ml == pytest.approx(5.0)
    firmware.answer(write_register(1, 4, 0))
    now_s = 20.0
    assert firmware.pumped_ml == pytest.approx(5.0)
