"""The host: its clock, its serial ports with the ink station behind them, and what is said when it is too busy."""

from __future__ import annotations

import asyncio
import os
import time
import tty
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from brushloop.collect.errors import CameraLate, describe
from brushloop.drivers.errors import ConnectionLost, DeviceTimeout, NotConnected, Stale
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import SerialPort
from brushloop.drivers.ink.simulator import InstrumentServer, StationFirmware
from brushloop.drivers.ink.station import InkStation, InkStationConfig
from brushloop.drivers.sim.rig import HOST
from tests.waiting import until


def test_the_host_clock_goes_on_when_wall_time_is_set_back(monkeypatch: pytest.MonkeyPatch):
    clock = Clock()
    before = clock.now_ns()
    hour_ago = time.time_ns() - 3600 * 10**9
    monkeypatch.setattr(time, "time_ns", lambda: hour_ago)
    readings = [clock.now_ns() for _ in range(100)]
    assert before <= readings[0]
    assert readings == sorted(readings)
    assert readings[-1] - before < 10**9


@pytest.mark.parametrize(
    "late",
    [
        lambda: CameraLate("the camera's delay is not steady: use a cable instead of Wi-Fi."),
        lambda: Stale("force", 130.0, 100.0),
        lambda: DeviceTimeout("camera", "fresh", "no valid new frame", remedy="Check cable, light and stream."),
    ],
)
def test_what_comes_late_on_a_loaded_computer_says_so(late: type[Exception], monkeypatch: pytest.MonkeyPatch):
    assert "computer" not in describe(late())
    monkeypatch.setattr(os, "getloadavg", lambda: (23.0, 9.0, 3.0))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert "This computer is too busy (load 23.0 on 2 cores)" in describe(late())


def station_at(path: str) -> InkStation:
    return InkStation(InkStationConfig(kind="ink-station", port=path, dose_ml=2.0, light=0.5), Clock())


@pytest.fixture
async def line() -> AsyncIterator[InstrumentServer]:
    line = InstrumentServer(StationFirmware())
    await line.start(HOST, 0)
    yield line
    await line.stop()


@pytest.fixture
async def station(line: InstrumentServer) -> AsyncIterator[InkStation]:
    station = station_at(f"socket://{HOST}:{line.port}")
    await station.connect()
    yield station
    await station.close()


async def test_a_pulled_cable_is_a_lost_connection_at_once(line: InstrumentServer, station: InkStation):
    line.next_fault = lambda: "unplug"
    with pytest.raises(ConnectionLost, match=r"reached the well.*Check cable") as lost:
        await station.dose(1.0)
    assert lost.value.op == "dose"
    with pytest.raises(ConnectionLost, match="cannot open"):
        await station_at(f"socket://{HOST}:{line.port}").connect()


async def test_over_the_terminal_of_a_serial_line_a_device_answers_until_its_cable_is_pulled() -> None:
    """As in a lab: the loopback rig's lines are carried by a network, which pyserial opens by other code."""
    device, end = os.openpty()
    tty.setraw(end)  # or the terminal would echo, and translate line ends
    firmware, loop = StationFirmware(), asyncio.get_running_loop()
    loop.add_reader(device, lambda: os.write(device, firmware.answer(os.read(device, 4096)) or b""))
    station = station_at(os.ttyname(end))
    assert (await station.connect()).simulated
    before_ml = firmware.well.ml
    await station.dose(0.5)
    assert firmware.well.ml - before_ml == pytest.approx(0.5)
    loop.remove_reader(device)
    os.close(device)
    with pytest.raises(ConnectionLost):
        await station.level()
    await station.close()
    os.close(end)


async def test_a_port_that_is_missing_or_held_by_somebody_else_is_not_opened(tmp_path: Path):
    nowhere = station_at(str(tmp_path / "ttyUSB0"))
    with pytest.raises(ConnectionLost, match=r"cannot open .*ttyUSB0"):
        await nowhere.connect()
    with pytest.raises(NotConnected):
        await nowhere.light()
    await nowhere.close()
    ends = os.openpty()
    holder, other = (SerialPort("ink", os.ttyname(ends[1]), 9600) for _ in range(2))
    await holder.open()
    with pytest.raises(ConnectionLost, match="lock"):
        await other.open()
    await holder.close()
    for end in ends:
        os.close(end)


async def test_closing_ends_an_exchange_that_waits(
    line: InstrumentServer, station: InkStation, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("brushloop.drivers.ink.station.REPLY_S", 1000.0)
    line.next_fault = lambda: "mute"
    asking = asyncio.create_task(station.light())
    await until(lambda: line.instrument.light == 0.5, "the request to arrive")  # type: ignore[attr-defined]
    await station.close()
    with pytest.raises(NotConnected):
        await asking


async def test_an_exchange_that_is_cancelled_ends_before_the_next_begins(line: InstrumentServer, station: InkStation):
    on_the_line: list[str] = []
    faults, reply = iter(["late"]), line.write
    line.next_fault = lambda: (on_the_line.append("request"), next(faults, None))[1]
    line.write = lambda *sent: (on_the_line.append("reply"), reply(*sent))[1]  # type: ignore[method-assign]
    asking = asyncio.create_task(station.light())
    await asyncio.sleep(0)
    asking.cancel()
    with pytest.raises(asyncio.CancelledError):
        await asking
    assert await station.level() == 0.5
    assert on_the_line == ["request", "reply"] * 2
