"""Transcripts of the ink station, and what the driver does when the line misbehaves."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

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
from brushloop.drivers.host import Clock, HostClock
from brushloop.drivers.ink import station as station_module
from brushloop.drivers.ink.port import DoseLost, InkRefused
from brushloop.drivers.ink.simulator import PtyLine, StationFirmware
from brushloop.drivers.ink.station import InkStation, InkStationConfig, seal
from tests.drivers.failing import fail_requests, scripted

TIMEOUT_S = 0.3
"""Long enough for a busy machine to answer where an answer comes."""
HELLO = (b"000 identify*6A60\n", b"000 ok ink-station 1 1.0.0 real*8310\n")
DOSE = b"001 dose 0.500*7A5F\n"


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated station answers at once; without an answer the driver gives up soon."""
    monkeypatch.setattr(station_module, "REPLY_S", TIMEOUT_S)
    monkeypatch.setattr(station_module, "DOSE_S_PER_ML", 0.0)
    monkeypatch.setattr(station_module, "CONNECT_ATTEMPTS", 2)


def station_at(path: str, clock: Clock | None = None) -> InkStation:
    table = InkStationConfig(kind="ink-station", port=path, dose_ml=2.0, light=0.5)
    return InkStation(table, clock or HostClock())


@pytest.fixture
def firmware() -> StationFirmware:
    return StationFirmware()


@pytest.fixture
async def line(firmware: StationFirmware) -> AsyncIterator[PtyLine]:
    with PtyLine(firmware, late_s=1.5 * TIMEOUT_S) as line:
        yield line


@pytest.fixture
async def station(line: PtyLine) -> AsyncIterator[InkStation]:
    station = station_at(line.path)
    await station.connect()
    yield station
    await station.close()


async def test_a_session_reads_like_the_documented_one():
    exchanges = [
        HELLO,
        (seal(1, "light 0.500"), seal(1, "ok")),
        (seal(2, "dose 1.250"), seal(2, "ok 1.250")),
        (seal(3, "level"), seal(3, "ok 0.730")),
        (seal(4, "dose 0.500"), seal(4, "err 4 reservoir is empty")),
    ]
    with scripted(exchanges) as path:
        station = station_at(path)
        assert isinstance(station, Ink)
        identity = await station.connect()
        assert (identity.model, identity.firmware, identity.simulated) == ("ink-station", "1.0.0", False)
        assert await station.light() == 0.5
        await station.dose(1.25)
        assert await station.level() == 0.73
        with pytest.raises(InkRefused, match=r"reservoir is empty.*Nothing was done.*Refill") as refusal:
            await station.dose(0.5)
        assert refusal.value.code == 4
        await station.close()


async def test_a_lost_reply_is_asked_for_again_with_the_same_line_and_then_says_what_may_have_happened():
    again = DOSE.replace(b"001 dose 0.500*7A5F", seal(2, "dose 0.500").strip())
    exchanges = [HELLO, (DOSE, b""), (DOSE, b"001 ok 0.500*41C5\n"), (again, b""), (again, b"")]
    with scripted(exchanges) as path:
        station = station_at(path)
        await station.connect()
        await station.dose(0.5)
        with pytest.raises(DeviceTimeout, match=r"Between 0 and 0.500 ml may be in the well"):
            await station.dose(0.5)
        await station.close()


@pytest.mark.parametrize(
    ("reply", "error", "says"),
    [
        (b"001 ok 1.5*CD6C\n", ProtocolViolation, "above 1"),
        (b"001 ok nan*1429\n", ProtocolViolation, "not a decimal"),
        (b"001 ok*C626\n", ProtocolViolation, "expected one number"),
        (b"001 err 6 jammed*4073\n", InkRefused, "Look at the pump"),
    ],
)
async def test_a_level_that_makes_no_sense_is_refused(reply: bytes, error: type[DeviceError], says: str):
    with scripted([HELLO, (b"001 level*243E\n", reply)]) as path:
        station = station_at(path)
        await station.connect()
        with pytest.raises(error, match=says):
            await station.level()
        await station.close()


async def test_a_dose_that_comes_out_smaller_is_an_error():
    with scripted([HELLO, (DOSE, b"001 ok 0.400*8194\n")]) as path:
        station = station_at(path)
        await station.connect()
        with pytest.raises(DeviceError, match=r"gave 0.400 ml instead of 0.500 ml"):
            await station.dose(0.5)
        await station.close()


async def test_a_board_that_starts_slowly_and_chatters_is_waited_for(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(station_module, "CONNECT_ATTEMPTS", 3)
    hello, answer = HELLO
    with scripted([(hello, b""), (hello, b"\x00\xffboot v1\r\n"), (hello, answer)]) as path:
        station = station_at(path)
        await station.connect()
        await station.close()


@pytest.mark.parametrize("answer", [b"000 ok ink-station 2 9.0 real*24F2\n", b"000 ok gcode 1.1 real x*EE49\n"])
async def test_another_device_is_refused_and_the_port_closed(answer: bytes):
    with scripted([(HELLO[0], answer)]) as path:
        station = station_at(path)
        with pytest.raises(ProtocolViolation, match=r"expected ink-station with protocol 1.*Check that the path"):
            await station.connect()
        with pytest.raises(NotConnected):
            await station.level()


@pytest.mark.parametrize("fault", ["deaf", "mute", "garbage", "late", "split", "damaged", "mistaken", "echo"])
async def test_one_fault_gives_the_dose_once_and_one_that_lasts_is_an_error_in_time(
    fault: str, line: PtyLine, firmware: StationFirmware, station: InkStation
):
    fail_requests(line, fault)
    await station.dose(1.0)
    assert firmware.well.ml == 11.0
    assert await station.level() == 0.55
    if fault not in ("split", "late"):
        fail_requests(line, fault, fault)
        error = DeviceTimeout if fault in ("deaf", "mute") else ProtocolViolation
        with pytest.raises(error, match="may be in the well"):
            await station.dose(1.0)
        assert firmware.well.ml == (11.0 if fault == "deaf" else 12.0)
        assert await station.level() == pytest.approx(firmware.well.ml / 20.0)


async def test_a_pulled_cable_is_a_lost_connection_at_once_and_leads_to_no_other_station(
    line: PtyLine, station: InkStation
):
    fail_requests(line, "unplug")
    with pytest.raises(ConnectionLost, match=r"may be in the well.*Check cable") as lost:
        await station.dose(1.0)
    assert lost.value.op == "dose"
    with pytest.raises(ConnectionLost):
        await station.level()
    # the kernel gives the number of the closed terminal to the next one
    with PtyLine(StationFirmware()), pytest.raises(ConnectionLost, match="cannot open"):
        await station.connect()


async def test_a_port_that_is_missing_or_held_by_somebody_else_is_not_opened(
    tmp_path: Path, line: PtyLine, station: InkStation
):
    nowhere = station_at(str(tmp_path / "ttyUSB0"))
    with pytest.raises(ConnectionLost, match=r"cannot open .*ttyUSB0"):
        await nowhere.connect()
    with pytest.raises(NotConnected):
        await nowhere.light()
    await nowhere.close()
    with pytest.raises(ConnectionLost, match="lock"):
        await station_at(line.path).connect()
    await station.light()


async def test_closing_ends_an_exchange_that_waits(line: PtyLine, station: InkStation, monkeypatch: pytest.MonkeyPatch):
    fail_requests(line, "mute", "mute")
    await station.close()
    monkeypatch.setattr(station_module, "REPLY_S", 30.0)
    connecting = asyncio.create_task(station.connect())
    await asyncio.sleep(0.1)
    async with asyncio.timeout(10.0):  # the exchange itself would wait for 30 s
        await station.close()
        with pytest.raises(NotConnected):
            await connecting


async def test_a_cancelled_request_does_not_disturb_the_next(line: PtyLine, station: InkStation):
    fail_requests(line, "late")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.03):
            await station.light()
    assert await station.level() == 0.5


class StillClock:
    def __init__(self) -> None:
        self.ns = 0

    def now_ns(self) -> int:
        return self.ns


async def test_the_limit_per_minute_slides_and_counts_what_was_not_confirmed(line: PtyLine, firmware: StationFirmware):
    clock = StillClock()
    station = station_at(line.path, clock)
    await station.connect()
    await station.dose(2.0)
    clock.ns = 30 * 10**9
    fail_requests(line, "deaf", "deaf")
    with pytest.raises(DeviceTimeout):
        await station.dose(2.0)
    with pytest.raises(LimitExceeded, match=r"dose per minute = 5\.500"):
        await station.dose(1.5)
    clock.ns = 60 * 10**9
    await station.dose(1.5)
    with pytest.raises(LimitExceeded):
        await station.dose(2.0)
    assert firmware.well.ml == 13.5
    await station.close()


async def test_a_well_is_filled_up_to_its_level_and_a_dose_that_does_not_arrive_is_told(
    firmware: StationFirmware, station: InkStation, monkeypatch: pytest.MonkeyPatch
):
    firmware.well.ml = 0.4 * firmware.well.capacity_ml
    well = await station.replenish(dips=0)
    assert well.level is not None
    assert well.level >= 0.5
    assert well.dosed_ml == pytest.approx(firmware.well.ml - 0.4 * firmware.well.capacity_ml)
    assert await station.replenish(dips=1) == well, "it is full"
    firmware.well.ml = 1.0
    monkeypatch.setattr(firmware.well, "add", lambda _volume_ml: None)  # the tube has come off
    with pytest.raises(DoseLost, match="Look at the tube"):
        await station.replenish(dips=2)
    firmware.well.ml = 19.0  # somebody poured
    assert (await station.replenish(dips=3)).dosed_ml == well.dosed_ml + 2.0, "the lost dose was given as well"


async def test_a_station_refuses_what_it_cannot_do(firmware: StationFirmware, station: InkStation):
    firmware.lid_open = False
    with pytest.raises(InkRefused, match="Open the lid"):
        await station.dose(1.0)
    firmware.lid_open = True
    firmware.well.ml = 19.5
    with pytest.raises(InkRefused, match="overflow"):
        await station.dose(1.0)
    assert firmware.reservoir_ml == 100.0
