"""Ink devices on a simulated line: the station's dialogue, and a pump whose last command is always a stop."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.host import Clock, HostClock
from brushloop.drivers.ink import port as port_module
from brushloop.drivers.ink import pump as pump_module
from brushloop.drivers.ink import station as station_module
from brushloop.drivers.ink.port import InkRefused
from brushloop.drivers.ink.pump import ModbusPump, ModbusPumpConfig
from brushloop.drivers.ink.simulator import PtyLine, PumpFirmware, StationFirmware
from brushloop.drivers.ink.station import InkStation, InkStationConfig, seal
from tests.drivers.failing import PatientLine, SetClock, scripted
from tests.waiting import until


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No reply is too late while one is being made, a silence ends at once, and a busy machine may hold a dose up."""
    monkeypatch.setattr(port_module, "time", PatientLine.clock)
    monkeypatch.setattr(pump_module, "MAX_OVERRUN_S", math.inf)
    monkeypatch.setattr(station_module, "CONNECT_ATTEMPTS", 2)


# ---------------------------------------------------------------- the station

HELLO = (b"000 identify*6A60\n", b"000 ok ink-station 1 1.0.0 real*8310\n")
DOSE = b"001 dose 0.500*7A5F\n"
LEVEL = b"001 level*243E\n"


def station_at(path: str, clock: Clock | None = None) -> InkStation:
    table = InkStationConfig(kind="ink-station", port=path, dose_ml=2.0, light=0.5)
    return InkStation(table, clock or HostClock())


@asynccontextmanager
async def talking(*exchanges: tuple[bytes, bytes]) -> AsyncIterator[InkStation]:
    """A connected station that expects these requests and nothing else."""
    with scripted(HELLO, *exchanges) as path:
        station = station_at(path)
        await station.connect()
        yield station
        await station.close()


@pytest.fixture
def well() -> StationFirmware:
    return StationFirmware()


@pytest.fixture
async def station_line(well: StationFirmware) -> AsyncIterator[PatientLine]:
    with PatientLine(well) as line:
        yield line


@pytest.fixture
async def station(station_line: PatientLine) -> AsyncIterator[InkStation]:
    station = station_at(station_line.path)
    await station.connect()
    yield station
    await station.close()


async def test_a_session_reads_like_the_documented_one():
    exchanges = [
        (seal(1, "light 0.500"), seal(1, "ok")),
        (seal(2, "dose 1.250"), seal(2, "ok 1.250")),
        (seal(3, "level"), seal(3, "ok 0.730")),
        (seal(4, "dose 0.500"), seal(4, "err 4 reservoir is empty")),
    ]
    async with talking(*exchanges) as station:
        assert await station.light() == 0.5
        await station.dose(1.25)
        assert await station.level() == 0.73
        with pytest.raises(InkRefused, match=r"refused with 4 \(reservoir is empty\).*Nothing was done.*Refill"):
            await station.dose(0.5)


@pytest.mark.parametrize(
    ("exchanges", "error", "says"),
    [
        ([(LEVEL, b"001 ok 1.5*CD6C\n")], ProtocolViolation, "above 1"),
        ([(LEVEL, b"001 ok*C626\n")], ProtocolViolation, "not a decimal: ''"),
        ([(LEVEL, b"001 err 6 jammed*4073\n")], InkRefused, "Look at the pump"),
        ([(DOSE, b"001 ok 0.400*8194\n")], DeviceError, r"gave 0.400 ml instead of 0.500 ml"),
        ([(DOSE, b""), (DOSE, b"")], DeviceTimeout, r"Between 0 and 0.500 ml may be in the well"),
    ],
)
async def test_a_reply_that_is_lost_twice_or_makes_no_sense_is_an_error(
    exchanges: list[tuple[bytes, bytes]], error: type[DeviceError], says: str
):
    async with talking(*exchanges) as station:
        with pytest.raises(error, match=says):
            await (station.level() if exchanges[0][0] == LEVEL else station.dose(0.5))


async def test_a_board_that_starts_slowly_is_waited_for_and_another_device_is_refused():
    hello, answer = HELLO
    with scripted((hello, b""), (hello, answer)) as path:
        station = station_at(path)
        identity = await station.connect()
        assert (identity.model, identity.firmware, identity.simulated) == ("ink-station", "1.0.0", False)
        await station.close()
    for other in (b"000 ok ink-station 2 9.0 real*24F2\n", b"000 ok gcode 1.1 real x*EE49\n"):
        with scripted((hello, other)) as path:
            station = station_at(path)
            with pytest.raises(ProtocolViolation, match=r"expected ink-station with protocol 1.*Check that the path"):
                await station.connect()
            await station.close()
            with pytest.raises(NotConnected):
                await station.level()


@pytest.mark.parametrize("fault", ["deaf", "mute", "garbage", "late"])
async def test_one_fault_gives_the_dose_once_and_one_that_lasts_is_an_error(
    fault: str, station_line: PatientLine, well: StationFirmware, station: InkStation
):
    station_line.fail(fault)
    await station.dose(1.0)
    assert well.well.ml == 11.0
    assert await station.level() == 0.55
    if fault != "late":
        station_line.fail(fault, fault)
        with pytest.raises((DeviceTimeout, ProtocolViolation), match="may be in the well"):
            await station.dose(1.0)
        assert well.well.ml == (11.0 if fault == "deaf" else 12.0)
        assert await station.level() == pytest.approx(well.well.ml / 20.0)


async def test_a_pulled_cable_is_a_lost_connection_at_once_and_leads_to_no_other_station(
    station_line: PatientLine, station: InkStation
):
    station_line.fail("unplug")
    with pytest.raises(ConnectionLost, match=r"may be in the well.*Check cable") as lost:
        await station.dose(1.0)
    assert lost.value.op == "dose"
    # the kernel gives the number of the closed terminal to the next one
    with PtyLine(StationFirmware()), pytest.raises(ConnectionLost, match="cannot open"):
        await station_at(station_line.path).connect()


async def test_a_port_that_is_missing_or_held_by_somebody_else_is_not_opened(
    tmp_path: Path, station_line: PatientLine, station: InkStation
):
    nowhere = station_at(str(tmp_path / "ttyUSB0"))
    with pytest.raises(ConnectionLost, match=r"cannot open .*ttyUSB0"):
        await nowhere.connect()
    with pytest.raises(NotConnected):
        await nowhere.light()
    await nowhere.close()
    with pytest.raises(ConnectionLost, match="lock"):
        await station_at(station_line.path).connect()
    await station.light()


async def test_closing_ends_an_exchange_that_waits_and_a_cancelled_one_does_not_disturb_the_next(
    station_line: PatientLine, station: InkStation
):
    faults = iter(["mute", "late"])  # the clock stands still: each would wait for ever
    station_line.next_fault = lambda: next(faults, None)
    asking = asyncio.create_task(station.light())
    await until(lambda: station_line.instrument.light == 0.5, "the request to arrive")  # type: ignore[attr-defined]
    await station.close()
    with pytest.raises(NotConnected):
        await asking
    station = station_at(station_line.path)
    await station.connect()
    asking = asyncio.create_task(station.light())
    await asyncio.sleep(0)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    assert await station.level() == 0.5
    await station.close()


async def test_the_limit_per_minute_slides_and_counts_what_was_not_confirmed(
    station_line: PatientLine, well: StationFirmware
):
    minute = SetClock()
    station = station_at(station_line.path, minute)
    await station.connect()
    await station.dose(2.0)
    minute.s = 30.0
    station_line.fail("deaf", "deaf")
    with pytest.raises(DeviceTimeout):
        await station.dose(2.0)
    with pytest.raises(LimitExceeded, match=r"dose per minute = 5\.500"):
        await station.dose(1.5)
    minute.s = 60.0
    await station.dose(1.5)
    with pytest.raises(LimitExceeded):
        await station.dose(2.0)
    assert well.well.ml == 13.5
    await station.close()


# ---------------------------------------------------------------- the pump

ML_PER_REV = 0.12  # at 50 rpm: 0.1 ml/s
PROBE = bytes.fromhex("01 06 00 04 00 00 37 F4")  # a stop with a wrong CRC
STOP = bytes.fromhex("01 06 00 04 00 00 C8 0B")
SPEED = bytes.fromhex("01 06 00 01 13 88 D5 5C")
START = bytes.fromhex("01 06 00 04 00 01 09 CB")
REFUSED = bytes.fromhex("01 86 02 C3 A1")
CONNECTED = [(PROBE, b""), (STOP, STOP)]
BYE = [(STOP, STOP)]
SILENT = (STOP, b"")


def pump_at(path: str, *, dose_ml: float = 2.0, every_dips: int = 5) -> ModbusPump:
    table = ModbusPumpConfig(
        kind="modbus-pump", port=path, ml_per_revolution=ML_PER_REV, dose_ml=dose_ml, every_dips=every_dips
    )
    return ModbusPump(table, HostClock())


@pytest.fixture
def rotor() -> PumpFirmware:
    return PumpFirmware(ml_per_revolution=ML_PER_REV)


@pytest.fixture
async def pump_line(rotor: PumpFirmware) -> AsyncIterator[PatientLine]:
    with PatientLine(rotor) as line:
        yield line


@pytest.fixture
async def pump(pump_line: PatientLine, rotor: PumpFirmware) -> AsyncIterator[ModbusPump]:
    pump = pump_at(pump_line.path)
    await pump.connect()
    yield pump
    await pump.close()
    assert not rotor.running


async def test_a_dose_sets_the_speed_starts_and_stops():
    with scripted(*CONNECTED, (SPEED, SPEED), (START, START), (STOP, STOP), *BYE) as path:
        pump = pump_at(path)
        identity = await pump.connect()
        assert (identity.model, identity.simulated) == ("Modbus RTU pump, unit 1", False)
        began = time.monotonic()
        await pump.dose(0.015)
        assert time.monotonic() - began >= 0.15
        assert (await pump.level(), await pump.light()) == (None, None)
        for volume_ml in (0.009, 2.001, math.nan):
            with pytest.raises(LimitExceeded, match="ml is outside"):
                await pump.dose(volume_ml)
        await pump.close()


async def test_it_doses_before_every_nth_dip(pump_line: PatientLine):
    pump = pump_at(pump_line.path, dose_ml=0.02, every_dips=3)
    await pump.connect()
    assert [(await pump.replenish(), pump.dosed_ml)[1] for _ in range(7)] == [0.0, 0.0, 0.02, 0.02, 0.02, 0.04, 0.04]
    await pump.close()
    assert pump._table.doses_ml(7) == pytest.approx(0.04)


async def test_a_line_that_echoes_is_refused():
    with scripted((PROBE, PROBE)) as path:
        pump = pump_at(path)
        with pytest.raises(ProtocolViolation, match=r"echoes.*Switch off local echo"):
            await pump.connect()
        await pump.close()
        with pytest.raises(NotConnected):
            await pump.dose(0.1)


@pytest.mark.parametrize(
    ("exchanges", "error", "says"),
    [
        ([(SPEED, REFUSED)], InkRefused, r"2 \(illegal register\). The pump was not started"),
        ([(SPEED, SPEED), (START, START), SILENT, SILENT, SILENT], DeviceTimeout, "may still be running"),
    ],
    ids=["a speed that is refused", "a stop without a reply, sent three times"],
)
async def test_a_dose_that_fails_says_how_the_pump_is_left(
    exchanges: list[tuple[bytes, bytes]], error: type[DeviceError], says: str
):
    runs_on = exchanges[-1] == SILENT
    with scripted(*CONNECTED, *exchanges, *([SILENT] * 3 if runs_on else BYE)) as path:
        pump = pump_at(path)
        await pump.connect()
        with pytest.raises(error, match=says):
            await pump.dose(0.01)
        if runs_on:  # closing tries again
            with pytest.raises(DeviceTimeout, match="may still be running"):
                await pump.close()
        await pump.close()


@pytest.mark.parametrize("times", [1, 3])
async def test_a_cancelled_dose_stops_the_pump_however_often_it_is_cancelled(
    rotor: PumpFirmware, pump_line: PatientLine, pump: ModbusPump, times: int
):
    dosing = asyncio.create_task(pump.dose(2.0))
    await until(lambda: rotor.running, "the pump to run")
    pump_line.fail("late")
    for _ in range(times):
        dosing.cancel()
        await asyncio.sleep(0.02)
    with pytest.raises(asyncio.CancelledError):
        await dosing
    assert not rotor.running


async def test_a_cancelled_dose_whose_stop_fails_says_so(rotor: PumpFirmware, pump_line: PatientLine):
    pump = pump_at(pump_line.path)
    await pump.connect()
    dosing = asyncio.create_task(pump.dose(2.0))
    await until(lambda: rotor.running, "the pump to run")
    pump_line.unplug()
    dosing.cancel()
    with pytest.raises(asyncio.CancelledError) as cancelled:
        await dosing
    assert "may still be running" in cancelled.value.__notes__[0]
    with pytest.raises(ConnectionLost, match=r"may still be running.*Check cable"):
        await pump.close()


@pytest.mark.parametrize("fault", ["deaf", "garbage", "late"])
@pytest.mark.parametrize("at", ["speed", "start", "stop"])
async def test_a_fault_anywhere_leaves_the_pump_stopped_and_no_late_reply_passes_for_the_next(
    fault: str, at: str, rotor: PumpFirmware, pump_line: PatientLine, pump: ModbusPump
):
    pump_line.fail(*[None] * ("speed", "start", "stop").index(at), fault)
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


@pytest.mark.parametrize("after_requests", [0, 1, 2])
async def test_closing_in_mid_dose_leaves_the_pump_stopped(
    rotor: PumpFirmware, pump_line: PatientLine, pump: ModbusPump, after_requests: int
):
    requests: list[None] = []
    pump_line.next_fault = lambda: requests.append(None)
    dosing = asyncio.create_task(pump.dose(0.02))
    await until(lambda: len(requests) >= after_requests, "requests")
    await pump.close()
    with pytest.raises(NotConnected):
        await dosing
    assert not rotor.running


async def test_a_host_that_was_held_up_reports_the_excess(
    rotor: PumpFirmware, pump: ModbusPump, monkeypatch: pytest.MonkeyPatch
):
    sleep, ran = asyncio.sleep, list[bool]()

    async def sleep_and_be_held_up(delay_s: float) -> None:
        await sleep(delay_s)
        ran.append(rotor.running)
        time.sleep(0.25)  # the fault under test

    with monkeypatch.context() as holding_up:
        holding_up.setattr(pump_module, "MAX_OVERRUN_S", 0.1)
        holding_up.setattr("brushloop.drivers.ink.pump.asyncio.sleep", sleep_and_be_held_up)
        with pytest.raises(DeviceError, match=r"instead of 0.10 s\. About .* too much.*is stopped"):
            await pump.dose(0.01)
    assert ran == [True]
    assert not rotor.running
