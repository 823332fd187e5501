"""Transcripts of the Modbus pump: whatever happens, the last thing on the wire is a stop."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.devices import Ink
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.host import HostClock
from brushloop.drivers.ink import pump as pump_module
from brushloop.drivers.ink.port import InkRefused
from brushloop.drivers.ink.pump import ModbusPump, ModbusPumpConfig, exception, seal, write_register
from brushloop.drivers.ink.simulator import PtyLine, PumpFirmware
from tests.drivers.failing import fail_requests, scripted

TIMEOUT_S = 0.3
"""Long enough for a busy machine to answer where an answer comes."""
ML_PER_REV = 0.12  # at 50 rpm: 0.1 ml/s
PROBE = bytes.fromhex("01 06 00 04 00 00 37 F4")  # a stop with a wrong CRC
STOP = bytes.fromhex("01 06 00 04 00 00 C8 0B")
SPEED = bytes.fromhex("01 06 00 01 13 88 D5 5C")
START = bytes.fromhex("01 06 00 04 00 01 09 CB")
CONNECTED = [(PROBE, b""), (STOP, STOP)]
BYE = [(STOP, STOP)]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated pump answers at once; without an answer the driver gives up soon."""
    monkeypatch.setattr(pump_module, "REPLY_S", TIMEOUT_S)
    monkeypatch.setattr(pump_module, "ECHO_S", 0.02)


def pump_at(path: str, *, dose_ml: float = 2.0, every_dips: int = 5) -> ModbusPump:
    table = ModbusPumpConfig(
        kind="modbus-pump", port=path, ml_per_revolution=ML_PER_REV, dose_ml=dose_ml, every_dips=every_dips
    )
    return ModbusPump(table, HostClock())


@pytest.fixture
def firmware() -> PumpFirmware:
    return PumpFirmware(ml_per_revolution=ML_PER_REV)


@pytest.fixture
async def line(firmware: PumpFirmware) -> AsyncIterator[PtyLine]:
    with PtyLine(firmware, late_s=1.5 * TIMEOUT_S) as line:
        yield line


@pytest.fixture
async def pump(line: PtyLine, firmware: PumpFirmware) -> AsyncIterator[ModbusPump]:
    pump = pump_at(line.path)
    await pump.connect()
    yield pump
    await pump.close()
    assert not firmware.running


async def test_a_dose_sets_the_speed_starts_and_stops():
    with scripted([*CONNECTED, (SPEED, SPEED), (START, START), (STOP, STOP), *BYE]) as path:
        pump = pump_at(path)
        assert isinstance(pump, Ink)
        identity = await pump.connect()
        assert (identity.model, identity.simulated) == ("Modbus RTU pump, unit 1", False)
        began = time.monotonic()
        await pump.dose(0.015)
        assert time.monotonic() - began >= 0.15
        assert (await pump.level(), await pump.light()) == (None, None)
        await pump.close()


async def test_it_doses_before_every_nth_dip(line: PtyLine):
    pump = pump_at(line.path, dose_ml=0.02, every_dips=3)
    await pump.connect()
    assert [(await pump.replenish(dips)).dosed_ml for dips in range(7)] == [0.0, 0.0, 0.02, 0.02, 0.02, 0.04, 0.04]
    await pump.close()
    assert pump._table.doses_ml(7) == pytest.approx(0.04)


async def test_a_line_that_echoes_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pump_module, "ECHO_S", 0.5)
    with scripted([(PROBE, PROBE)]) as path:
        pump = pump_at(path)
        with pytest.raises(ProtocolViolation, match=r"echoes.*Switch off local echo"):
            await pump.connect()
        with pytest.raises(NotConnected):
            await pump.dose(0.1)


async def test_where_no_pump_answers_nothing_stays_open():
    with scripted([(PROBE, b""), (STOP, b""), (STOP, b""), (STOP, b"")]) as path:
        pump = pump_at(path)
        with pytest.raises(DeviceTimeout, match="stop"):
            await pump.connect()
        with pytest.raises(NotConnected):
            await pump.dose(0.1)


REFUSED = bytes.fromhex("01 86 02 C3 A1")
SILENT = (STOP, b"")


@pytest.mark.parametrize(
    ("exchanges", "error", "says"),
    [
        ([(SPEED, REFUSED)], InkRefused, r"2 \(illegal register\). The pump was not started"),
        ([(SPEED, SPEED), (START, b""), (STOP, STOP)], DeviceTimeout, r"start: .*The pump is stopped"),
        ([(SPEED, SPEED), (START, START), SILENT, SILENT, SILENT], DeviceTimeout, "may still be running"),
    ],
    ids=["a speed that is refused", "a start without a reply", "a stop without a reply, sent three times"],
)
async def test_a_dose_that_fails_says_how_the_pump_is_left(
    exchanges: list[tuple[bytes, bytes]], error: type[DeviceError], says: str
):
    runs_on = exchanges[-1] == SILENT
    with scripted([*CONNECTED, *exchanges, *([SILENT] * 3 if runs_on else BYE)]) as path:
        pump = pump_at(path)
        await pump.connect()
        with pytest.raises(error, match=says):
            await pump.dose(0.01)
        if runs_on:  # closing tries again
            with pytest.raises(DeviceTimeout, match="may still be running"):
                await pump.close()
        await pump.close()


async def test_a_dose_delivers_what_was_asked(firmware: PumpFirmware, pump: ModbusPump):
    await pump.dose(0.015)
    assert firmware.pumped_ml == pytest.approx(0.015, abs=0.008)
    assert firmware.rpm == 50.0
    assert not firmware.running


@pytest.mark.parametrize("times", [1, 3])
async def test_a_cancelled_dose_stops_the_pump_however_often_it_is_cancelled(
    firmware: PumpFirmware, line: PtyLine, pump: ModbusPump, times: int
):
    dosing = asyncio.create_task(pump.dose(2.0))
    while not firmware.running:
        await asyncio.sleep(0.01)
    fail_requests(line, "late")
    for _ in range(times):
        dosing.cancel()
        await asyncio.sleep(0.02)
    with pytest.raises(asyncio.CancelledError):
        await dosing
    assert not firmware.running
    assert firmware.pumped_ml < 0.2


async def test_a_cancelled_dose_whose_stop_fails_says_so(firmware: PumpFirmware, line: PtyLine):
    pump = pump_at(line.path)
    await pump.connect()
    dosing = asyncio.create_task(pump.dose(2.0))
    while not firmware.running:
        await asyncio.sleep(0.01)
    line.unplug()
    dosing.cancel()
    with pytest.raises(asyncio.CancelledError) as cancelled:
        await dosing
    assert "may still be running" in cancelled.value.__notes__[0]
    with pytest.raises(ConnectionLost, match=r"may still be running.*Check cable"):
        await pump.close()


@pytest.mark.parametrize("fault", ["deaf", "garbage", "late", "mistaken"])
@pytest.mark.parametrize("at", ["start", "stop"])
async def test_a_fault_anywhere_leaves_the_pump_stopped(
    fault: str, at: str, firmware: PumpFirmware, line: PtyLine, pump: ModbusPump
):
    before = {"start": 1, "stop": 2}[at]
    fail_requests(line, *["split"] * before, fault)
    if at == "stop":
        await pump.dose(0.01)  # the second stop is confirmed
    else:
        with pytest.raises(DeviceError):
            await pump.dose(0.01)
    assert not firmware.running
    assert firmware.pumped_ml < 0.1


@pytest.mark.parametrize("wait_s", [0.0, 0.01, 0.03, 0.1])
async def test_closing_in_mid_dose_leaves_the_pump_stopped(firmware: PumpFirmware, line: PtyLine, wait_s: float):
    pump = pump_at(line.path)
    await pump.connect()
    fail_requests(line, *["split"] * 3)
    dosing = asyncio.create_task(pump.dose(0.01))
    await asyncio.sleep(wait_s)
    await pump.close()
    with pytest.raises(NotConnected):
        await dosing
    assert not firmware.running


async def test_a_late_reply_does_not_pass_for_the_next(line: PtyLine, firmware: PumpFirmware, pump: ModbusPump):
    fail_requests(line, "late")
    with pytest.raises(DeviceTimeout, match="not started"):
        await pump.dose(0.01)
    await pump.dose(0.01)
    assert firmware.starts == 1


async def test_a_host_that_was_held_up_reports_the_excess(
    firmware: PumpFirmware, pump: ModbusPump, monkeypatch: pytest.MonkeyPatch
):
    sleep, ran = asyncio.sleep, list[bool]()

    async def sleep_and_be_held_up(delay_s: float) -> None:
        await sleep(delay_s)
        ran.append(firmware.running)
        time.sleep(0.25)  # the fault under test

    with monkeypatch.context() as holding_up:
        holding_up.setattr(pump_module, "MAX_OVERRUN_S", 0.1)
        holding_up.setattr("brushloop.drivers.ink.pump.asyncio.sleep", sleep_and_be_held_up)
        with pytest.raises(DeviceError, match=r"instead of 0.10 s\. About .* too much.*is stopped"):
            await pump.dose(0.01)
    assert ran == [True]
    assert not firmware.running


async def test_a_dose_beyond_the_limits_is_never_sent():
    with scripted([*CONNECTED, *BYE]) as path:
        pump = pump_at(path)
        await pump.connect()
        for volume_ml in (0.0, 0.009, 2.001, -1.0, math.nan, math.inf):
            with pytest.raises(LimitExceeded, match="ml is outside"):
                await pump.dose(volume_ml)
        await pump.close()


@pytest.mark.parametrize(("ml_per_revolution", "rpm"), [(0.0, 50.0), (0.1, 0.0), (0.1, 601.0), (math.nan, 50.0)])
def test_a_pump_that_cannot_run_like_that_is_refused(ml_per_revolution: float, rpm: float):
    with pytest.raises(ValueError, match="Input should be"):
        ModbusPumpConfig(kind="modbus-pump", port="port", ml_per_revolution=ml_per_revolution, rpm=rpm)


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
    firmware.answer(write_register(1, 4, 1))
    now_s = 10.0
    assert firmware.pumped_ml == pytest.approx(5.0)
    firmware.answer(write_register(1, 4, 0))
    now_s = 20.0
    assert firmware.pumped_ml == pytest.approx(5.0)
