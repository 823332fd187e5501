"""Transcripts of the ink station, and what the driver does when the line misbehaves."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator

import pytest

from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    LimitExceeded,
    NotConnected,
    ProtocolViolation,
)
from brushloop.drivers.host import HostClock
from brushloop.drivers.ink.port import DoseLost, InkRefused
from brushloop.drivers.ink.simulator import PtyLine, StationFirmware
from brushloop.drivers.ink.station import InkStation, InkStationConfig, seal
from tests.drivers.failing import fail_requests

TIMEOUT_S = 0.3
"""Long enough for a busy machine to answer where an answer comes."""
HELLO = (b"000 identify*6A60\n", b"000 ok ink-station 1 1.0.0 real*8310\n")


class StillClock:
    def __init__(self) -> None:
        self.ns = 0

    def now_ns(self) -> int:
        return self.ns


def station_at(path: str, **options: float) -> InkStation:
    made = {"timeout_s": TIMEOUT_S, "s_per_ml": 0.0, "connect_attempts": 2, **options}
    return InkStation(table(path), HostClock(), **made)


def table(path: str) -> InkStationConfig:
    return InkStationConfig(kind="ink-station", port=path, dose_ml=2.0, light=0.5)


@pytest.fixture
def firmware() -> StationFirmware:
    return StationFirmware()


@pytest.fixture
async def line(firmware: StationFirmware) -> AsyncIterator[PtyLine]:
    with PtyLine(firmware, late_s=1.5 * TIMEOUT_S) as it:
        yield it


@pytest.fixture
async def station(line: PtyLine) -> AsyncIterator[InkStation]:
    it = station_at(line.path)
    await it.connect()
    yield it
    await it.close()


async def test_a_session_reads_like_the_documented_one(expected_protocol):
    exchanges = [
        HELLO,
        (seal(1, "light 0.500"), seal(1, "ok")),
        (seal(2, "dose 1.250"), seal(2, "ok 1.250")),
        (seal(3, "level"), seal(3, "ok 0.730")),
        (seal(4, "dose 0.500"), seal(4, "err 4 reservoir is empty")),
    ]
    with expected_protocol(exchanges) as path:
        station = station_at(path)
        identity = await station.connect()
        assert (identity.model, identity.firmware, identity.simulated) == ("ink-station", "1.0.0", False)
        await station.light()
        await station.dose(1.25)
        assert await station.level() == 0.73
        with pytest.raises(InkRefused, match=r"reservoir is empty.*Nothing was done.*Refill") as refusal:
            await station.dose(0.5)
        assert refusal.value.code == 4
        await station.close()


async def test_a_lost_reply_is_asked_for_again_with_the_same_line(expected_protocol):
    dose = b"001 dose 0.500*7A5F\n"
    with expected_protocol([HELLO, (dose, b""), (dose, b"001 ok 0.500*41C5\n")]) as path:
        station = station_at(path)
        await station.connect()
        await station.dose(0.5)
        await station.close()


async def test_a_dose_that_nobody_confirms_says_what_may_have_happened(expected_protocol):
    dose = b"001 dose 0.500*7A5F\n"
    with expected_protocol([HELLO, (dose, b""), (dose, b"")]) as path:
        station = station_at(path)
        await station.connect()
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
async def test_a_level_that_makes_no_sense_is_refused(expected_protocol, reply, error, says):
    with expected_protocol([HELLO, (b"001 level*243E\n", reply)]) as path:
        station = station_at(path)
        await station.connect()
        with pytest.raises(error, match=says):
            await station.level()
        await station.close()


async def test_a_dose_that_comes_out_smaller_is_an_error(expected_protocol):
    with expected_protocol([HELLO, (b"001 dose 0.500*7A5F\n", b"001 ok 0.400*8194\n")]) as path:
        station = station_at(path)
        await station.connect()
        with pytest.raises(DeviceError, match=r"gave 0.400 ml instead of 0.500 ml"):
            await station.dose(0.5)
        await station.close()


async def test_a_board_that_starts_slowly_and_chatters_is_waited_for(expected_protocol):
    hello, answer = HELLO
    with expected_protocol([(hello, b""), (hello, b"\x00\xffboot v1\r\n"), (hello, answer)]) as path:
        station = station_at(path, connect_attempts=3)
        await station.connect()
        await station.close()


@pytest.mark.parametrize("answer", [b"000 ok ink-station 2 9.0 real*24F2\n", b"000 ok gcode 1.1 real x*EE49\n"])
async def test_another_device_is_refused_and_the_port_closed(expected_protocol, answer):
    with expected_protocol([(HELLO[0], answer)]) as path:
        station = station_at(path)
        with pytest.raises(ProtocolViolation, match=r"expected ink-station with protocol 1.*Check that the path"):
            await station.connect()
        with pytest.raises(NotConnected):
            await station.level()


@pytest.mark.parametrize(
    "fault",
    [
        "deaf",
        "mute",
        "garbage",
        "late",
        "split",
        "damaged",
        "mistaken",
        "echo",
    ],
)
async def test_one_fault_of_any_kind_gives_the_dose_once(
    fault: str, line: PtyLine, firmware: StationFirmware, station: InkStation
):
    fail_requests(line, fault)
    await station.dose(1.0)
    assert firmware.well.ml == 11.0
    assert await station.level() == 0.55


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("deaf", DeviceTimeout),
        ("mute", DeviceTimeout),
        ("garbage", ProtocolViolation),
        ("damaged", ProtocolViolation),
        ("mistaken", ProtocolViolation),
        ("echo", ProtocolViolation),
    ],
)
async def test_a_fault_that_lasts_is_an_error_in_time_and_the_next_request_works(
    fault: str, error: type[DeviceError], line: PtyLine, firmware: StationFirmware, station: InkStation
):
    fail_requests(line, fault, fault)
    with pytest.raises(error, match="may be in the well"):
        await station.dose(1.0)
    assert firmware.well.ml == (10.0 if fault == "deaf" else 11.0)
    assert await station.level() == pytest.approx(firmware.well.ml / 20.0)


async def test_a_pulled_cable_is_a_lost_connection_at_once_and_stays_one(line: PtyLine, station: InkStation):
    fail_requests(line, "unplug")
    with pytest.raises(ConnectionLost, match=r"may be in the well.*Check cable") as lost:
        await station.dose(1.0)
    assert lost.value.op == "dose"
    with pytest.raises(ConnectionLost):
        await station.level()
    with pytest.raises(ConnectionLost, match="cannot open"):
        await station.connect()


async def test_a_lost_port_does_not_lead_to_the_station_that_was_given_its_number(line: PtyLine, station: InkStation):
    line.unplug()
    await station.close()
    with PtyLine(StationFirmware()), pytest.raises(ConnectionLost, match="cannot open"):
        await station.connect()


async def test_where_there_is_no_port_nothing_is_connected(tmp_path):
    station = station_at(str(tmp_path / "ttyUSB0"))
    with pytest.raises(ConnectionLost, match=r"cannot open .*ttyUSB0"):
        await station.connect()
    with pytest.raises(NotConnected):
        await station.light()
    await station.close()


async def test_a_port_that_somebody_else_holds_is_not_shared(line: PtyLine, station: InkStation):
    with pytest.raises(ConnectionLost, match="lock"):
        await station_at(line.path).connect()
    await station.light()


async def test_closing_ends_an_exchange_that_waits(line: PtyLine, station: InkStation):
    fail_requests(line, "mute", "mute")
    slow = station_at(line.path, timeout_s=30.0)
    await station.close()
    waiting = asyncio.create_task(slow.connect())
    await asyncio.sleep(0.1)
    async with asyncio.timeout(10.0):  # the exchange itself would wait for 30 s
        await slow.close()
        with pytest.raises(NotConnected):
            await waiting


async def test_a_cancelled_request_does_not_disturb_the_next(line: PtyLine, station: InkStation):
    fail_requests(line, "late")
    with pytest.raises(TimeoutError):
        async with asyncio.timeout(0.03):
            await station.light()
    assert await station.level() == 0.5


async def test_a_dose_beyond_the_limits_is_never_sent(expected_protocol):
    with expected_protocol([HELLO]) as path:
        station = station_at(path)
        await station.connect()
        for volume_ml in (0.0, -1.0, 2.001, math.nan, math.inf, 0.0004):
            with pytest.raises(LimitExceeded, match="ml is outside"):
                await station.dose(volume_ml)
        await station.close()


async def test_the_limit_per_minute_slides_and_counts_what_was_not_confirmed(line: PtyLine, firmware: StationFirmware):
    clock = StillClock()
    station = InkStation(table(line.path), clock, timeout_s=0.05, s_per_ml=0.0, attempts=1)
    await station.connect()
    await station.dose(2.0)
    clock.ns = 30 * 10**9
    fail_requests(line, "deaf")
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
