"""Ink devices on a simulated line: the station's dialogue, and a pump whose last command is always a stop."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from typing import TypeVar

import pytest

from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.ink.port import InkRefused
from brushloop.drivers.ink.pump import ModbusPump, ModbusPumpConfig
from brushloop.drivers.ink.simulator import PumpFirmware, StationFirmware
from brushloop.drivers.ink.station import CONNECT_ATTEMPTS, InkStation, InkStationConfig
from tests.drivers.ink.conftest import PORT, Line, Plug, loop
from tests.simulated_time import LoopClock
from tests.waiting import until

AnyDevice = TypeVar("AnyDevice", InkStation, ModbusPump)


async def connected(device: AnyDevice) -> AnyDevice:
    await device.connect()
    return device


# ---------------------------------------------------------------- the station

HELLO = b"000 identify*6A60\n"
DOSE = b"001 dose 0.500*7A5F\n"
LEVEL = b"001 level*243E\n"


def a_station() -> InkStation:
    return InkStation(InkStationConfig(kind="ink-station", port=PORT, dose_ml=2.0, light=0.5), LoopClock())


@pytest.fixture
def line(plug: Plug) -> Line:
    """That of a simulated station."""
    return plug(StationFirmware())


def given_ml(line: Line) -> float:
    """What the well has got of the station."""
    return line.instrument.well.ml - 10.0


async def test_a_session_sets_the_light_doses_and_tells_the_level_until_the_reservoir_is_empty(line: Line):
    station = await connected(a_station())
    assert await station.light() == line.instrument.light == 0.5
    await station.dose(1.25)
    assert (given_ml(line), await station.level()) == (1.25, 0.562)
    line.instrument.reservoir_ml = 0.0
    with pytest.raises(InkRefused, match=r"refused with 4 \(reservoir is empty\).*Nothing was done.*Refill"):
        await station.dose(0.5)


@pytest.mark.parametrize(
    ("asked", "reply", "error", "says"),
    [
        (LEVEL, b"001 ok 1.5*CD6C\n", ProtocolViolation, "above 1"),
        (LEVEL, b"001 err 6 jammed*4073\n", InkRefused, "Look at the pump"),
        (DOSE, b"001 ok 0.400*8194\n", DeviceError, r"gave 0.400 ml instead of 0.500 ml"),
    ],
)
async def test_a_reply_that_makes_no_sense_or_refuses_is_an_error(
    line: Line, asked: bytes, reply: bytes, error: type[DeviceError], says: str
):
    station = await connected(a_station())
    line.faults = [reply]
    with pytest.raises(error, match=says):
        await (station.level() if asked == LEVEL else station.dose(0.5))
    assert line.requests == [HELLO, asked]


async def test_a_board_that_starts_slowly_is_waited_for_and_another_device_is_refused(line: Line):
    line.faults = [*["mute"] * (CONNECT_ATTEMPTS - 1), b"000 ok ink-station 1 1.0.0 real*8310\n"]
    identity = await a_station().connect()
    assert (identity.model, identity.firmware, identity.simulated) == ("ink-station", "1.0.0", False)
    assert line.requests == [HELLO] * CONNECT_ATTEMPTS
    for other in (b"000 ok ink-station 2 9.0 real*24F2\n", b"000 ok gcode 1.1 real x*EE49\n"):
        station = a_station()
        line.faults = [other]
        with pytest.raises(ProtocolViolation, match=r"expected ink-station with protocol 1.*Check that this is"):
            await station.connect()
        await station.close()
        with pytest.raises(NotConnected):
            await station.level()


@pytest.mark.parametrize("fault", ["deaf", "mute", "garbage", "late"])
async def test_one_fault_gives_the_dose_once_and_one_that_lasts_is_an_error(fault: str, line: Line):
    station = await connected(a_station())
    line.faults = [fault]
    await station.dose(1.0)
    assert given_ml(line) == 1.0
    assert await station.level() == 0.55
    if fault != "late":
        line.faults = [fault, fault]
        with pytest.raises((DeviceTimeout, ProtocolViolation), match=r"how much of 1\.000 ml reached the well"):
            await station.dose(1.0)
        assert given_ml(line) == (1.0 if fault == "deaf" else 2.0)
        assert await station.level() == pytest.approx(line.instrument.well.ml / 20.0)


async def test_the_limit_per_minute_slides_and_counts_what_was_not_confirmed(line: Line):
    station = await connected(a_station())
    await station.dose(2.0)
    await asyncio.sleep(30.0)
    line.faults = ["deaf", "deaf"]
    with pytest.raises(DeviceTimeout):
        await station.dose(2.0)
    with pytest.raises(LimitExceeded, match=r"dose per minute = 5\.500"):
        await station.dose(1.5)
    await asyncio.sleep(30.0)
    await station.dose(1.5)
    with pytest.raises(LimitExceeded):
        await station.dose(2.0)
    assert given_ml(line) == 3.5


# ---------------------------------------------------------------- the pump

ML_PER_REV = 0.12  # at 50 rpm: 0.1 ml/s
PROBE = bytes.fromhex("01 06 00 04 00 00 37 F4")  # a stop with a wrong CRC
STOP = bytes.fromhex("01 06 00 04 00 00 C8 0B")
SPEED = bytes.fromhex("01 06 00 01 13 88 D5 5C")
START = bytes.fromhex("01 06 00 04 00 01 09 CB")
REFUSED = bytes.fromhex("01 86 02 C3 A1")


def a_pump(**fields: float) -> ModbusPump:
    table = {"kind": "modbus-pump", "port": PORT, "ml_per_revolution": ML_PER_REV, "dose_ml": 2.0, **fields}
    return ModbusPump(ModbusPumpConfig.model_validate(table), LoopClock())


@pytest.fixture
def rotor() -> PumpFirmware:
    return PumpFirmware(ml_per_revolution=ML_PER_REV)


@pytest.fixture
def pump_line(plug: Plug, rotor: PumpFirmware) -> Line:
    return plug(rotor)


@pytest.fixture
async def pump(pump_line: Line, rotor: PumpFirmware) -> AsyncIterator[ModbusPump]:
    pump = await connected(a_pump())
    yield pump
    await pump.close()
    assert not rotor.running


async def test_a_dose_sets_the_speed_starts_and_stops(pump_line: Line):
    pump = a_pump()
    identity = await pump.connect()
    assert (identity.model, identity.simulated) == ("Modbus RTU pump, unit 1", False)
    began_s = loop().time()
    await pump.dose(0.015)
    assert 0.15 <= loop().time() - began_s < 0.2
    assert (await pump.level(), await pump.light()) == (None, None)
    for volume_ml in (0.009, 2.001, math.nan):
        with pytest.raises(LimitExceeded, match="ml is outside"):
            await pump.dose(volume_ml)
    await pump.close()
    assert pump_line.requests == [PROBE, STOP, SPEED, START, STOP, STOP]


async def test_it_doses_before_every_nth_dip(pump_line: Line):
    pump = await connected(a_pump(dose_ml=0.02, every_dips=3))
    assert [(await pump.replenish(), pump.dosed_ml)[1] for _ in range(7)] == [0.0, 0.0, 0.02, 0.02, 0.02, 0.04, 0.04]
    assert pump._table.doses_ml(7) == pytest.approx(0.04)


async def test_a_line_that_echoes_is_refused(pump_line: Line):
    pump_line.faults = [PROBE]
    pump = a_pump()
    with pytest.raises(ProtocolViolation, match=r"echoes.*Switch off local echo"):
        await pump.connect()
    await pump.close()
    with pytest.raises(NotConnected):
        await pump.dose(0.1)


async def test_a_dose_that_the_pump_refuses_was_not_started(pump_line: Line, pump: ModbusPump):
    pump_line.faults = [REFUSED]
    with pytest.raises(InkRefused, match=r"2 \(illegal register\). The pump was not started"):
        await pump.dose(0.01)
    assert pump_line.requests == [PROBE, STOP, SPEED]


async def dosing(pump: ModbusPump, rotor: PumpFirmware) -> asyncio.Task[None]:
    """A dose that is under way."""
    task = asyncio.create_task(pump.dose(2.0))
    await until(lambda: rotor.running, "the pump to run")
    return task


@pytest.mark.parametrize("times", [1, 3])
async def test_a_cancelled_dose_stops_the_pump_however_often_it_is_cancelled(
    rotor: PumpFirmware, pump_line: Line, pump: ModbusPump, times: int
):
    dose = await dosing(pump, rotor)
    pump_line.faults = ["deaf"]
    for _ in range(times):
        dose.cancel()
        await asyncio.sleep(0)
    with pytest.raises(asyncio.CancelledError):
        await dose
    assert not rotor.running


@pytest.mark.parametrize("fault", ["deaf", "unplug"])
@pytest.mark.parametrize("cancelled", [True, False])
async def test_where_the_stop_fails_too_the_pump_may_still_be_running_and_closing_tries_again(
    fault: str, cancelled: bool, rotor: PumpFirmware, pump_line: Line
):
    pump = await connected(a_pump())
    dose = await dosing(pump, rotor)
    pump_line.faults = [fault] * 6  # the dose and closing send a stop three times each
    if cancelled:
        dose.cancel()
    with pytest.raises(asyncio.CancelledError if cancelled else DeviceError) as ended:
        await dose
    assert "may still be running" in (ended.value.__notes__[0] if cancelled else str(ended.value))
    with pytest.raises((DeviceTimeout, ConnectionLost), match=r"may still be running.*Check"):
        await pump.close()
    assert not pump_line.faults or fault == "unplug"


@pytest.mark.parametrize("fault", ["deaf", "garbage", "late"])
@pytest.mark.parametrize("at", ["speed", "start", "stop"])
async def test_a_fault_anywhere_leaves_the_pump_stopped_and_no_late_reply_passes_for_the_next(
    fault: str, at: str, rotor: PumpFirmware, pump_line: Line, pump: ModbusPump
):
    pump_line.faults = [*[None] * ("speed", "start", "stop").index(at), fault]
    if at == "stop":
        await pump.dose(0.01)  # the second stop is confirmed
    else:
        with pytest.raises(DeviceError, match="not started" if at == "speed" else "is stopped"):
            await pump.dose(0.01)
    assert not rotor.running
    starts = rotor.starts
    assert starts == (at == "stop" or (at == "start" and fault != "deaf"))
    await pump.dose(0.01)
    assert rotor.starts == starts + 1


async def test_a_reply_from_before_a_request_does_not_confirm_it(pump_line: Line, pump: ModbusPump):
    pump_line.came, pump_line.faults = SPEED, ["deaf"]
    with pytest.raises(DeviceTimeout, match="not started"):
        await pump.dose(0.01)


@pytest.mark.parametrize("requests", [0, 1, 2])
async def test_closing_in_mid_dose_leaves_the_pump_stopped(
    rotor: PumpFirmware, pump_line: Line, pump: ModbusPump, requests: int
):
    dose, before = asyncio.create_task(pump.dose(0.02)), len(pump_line.requests)
    while len(pump_line.requests) < before + requests:
        await asyncio.sleep(0)
    await pump.close()
    with pytest.raises(NotConnected):
        await dose
    assert not rotor.running


async def test_a_host_that_was_held_up_reports_the_excess(
    rotor: PumpFirmware, pump: ModbusPump, monkeypatch: pytest.MonkeyPatch
):
    sleep = asyncio.sleep

    async def sleep_and_be_held_up(delay_s: float) -> None:
        await sleep(delay_s)
        assert rotor.running
        loop().simulated.pass_s(0.6)

    with monkeypatch.context() as holding_up:
        holding_up.setattr("brushloop.drivers.ink.pump.asyncio.sleep", sleep_and_be_held_up)
        with pytest.raises(DeviceError, match=r"instead of 0.10 s\. About 0.06 ml too much.*is stopped"):
            await pump.dose(0.01)
    assert not rotor.running
