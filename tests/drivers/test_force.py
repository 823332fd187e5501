"""The force driver against a board on a bus in memory: what it reads, what it refuses, and how it ends."""

from __future__ import annotations

import asyncio
import math
import random
import threading
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import chain, count, pairwise, repeat
from unittest.mock import Mock

import can
import pytest

from brushloop.drivers.devices import ForceSample
from brushloop.drivers.errors import ConnectionLost, DeviceError, DeviceTimeout, NotConnected, Stale, Stuck
from brushloop.drivers.force import sri_m8123
from brushloop.drivers.force.simulator import ERROR_FRAME, CanFrame, ForceBoard
from brushloop.drivers.force.sri_m8123 import ForceTable, RoundAssembler, SriM8123, Wrench, encode_round
from brushloop.drivers.host import Clock
from tests.waiting import until

WRENCH: Wrench = (1.0, -2.0, 3.5, 0.25, -0.5, 0.125)
PERIOD_S = 0.005


@pytest.fixture(autouse=True)
def noiseless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most boards here measure without noise."""
    monkeypatch.setattr(sri_m8123, "STUCK_MS", math.inf)


class Bus:
    """As much of a `can.Bus` as the driver uses, with a board on it."""

    def __init__(self, board: ForceBoard) -> None:
        self._board = board
        self._frames: deque[CanFrame] = deque()

    def send(self, message: can.Message, timeout: float) -> None:
        self._board.obey(message.arbitration_id, bytes(message.data))

    def recv(self, _timeout: float) -> can.Message | None:
        if not self._frames:
            time.sleep(PERIOD_S)
            self._at_s = time.time()
            self._frames.extend(self._board.round())
        if not self._frames:
            return None
        can_id, data = self._frames.popleft()
        error = bool(can_id & ERROR_FRAME)
        return can.Message(self._at_s, can_id & ~ERROR_FRAME, error, False, error, data=data)

    def shutdown(self) -> None:
        pass


TABLE = ForceTable(kind="sri-m8123", interface="virtual", channel="a board")


@asynccontextmanager
async def sensing(board: ForceBoard, stale_ms: float = 1e6) -> AsyncIterator[SriM8123]:
    """A sensor that is connected to the board."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(can, "Bus", lambda *_, **__: Bus(board))
        sensor = SriM8123(TABLE.model_copy(update={"stale_ms": stale_ms}), Clock())
        await sensor.connect()
        yield sensor
        await sensor.close()


@pytest.fixture
def board() -> ForceBoard:
    return ForceBoard(lambda: WRENCH)


@pytest.fixture
async def sensor(board: ForceBoard) -> AsyncIterator[SriM8123]:
    async with sensing(board) as sensor:
        yield sensor


def readers() -> int:
    return sum(t.name == "force reader" for t in threading.enumerate())


async def test_connecting_starts_the_board_and_closing_stops_it(board: ForceBoard, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(can, "Bus", lambda *_, **__: Bus(board))
    sensor = SriM8123(TABLE, Clock())
    identity = await sensor.connect()
    assert (identity.model, identity.simulated) == ("SRI M8123B2 on virtual a board", True)
    assert (sensor.latest().force_n, sensor.latest().torque_nm) == (WRENCH[:3], WRENCH[3:])
    await sensor.close()
    assert not board.streaming
    assert readers() == 0
    with pytest.raises(NotConnected):
        sensor.latest()
    await sensor.close()


async def test_samples_are_stamped_and_counted_and_reach_the_listener_in_the_loop_until_close(sensor: SriM8123):
    seen: list[ForceSample] = []
    loops: set[object] = set()

    def listener(sample: ForceSample) -> None:
        seen.append(sample)
        loops.add(asyncio.get_running_loop())

    before_ns = time.time_ns() - 50_000_000
    sensor.listen(listener)
    await until(lambda: len(seen) >= 10, "the driver")
    await sensor.close()
    size = len(seen)
    await asyncio.sleep(0.05)
    assert len(seen) == size
    assert loops == {asyncio.get_running_loop()}
    assert [s.stamp.seq for s in seen] == list(range(seen[0].stamp.seq, seen[0].stamp.seq + size))
    for earlier, later in pairwise(seen):
        assert before_ns < earlier.stamp.host_ns < later.stamp.host_ns
        assert earlier.stamp.device_ns is not None
        assert abs(earlier.stamp.host_ns - earlier.stamp.device_ns) < 10**9


def latest_error(sensor: SriM8123) -> DeviceError | None:
    """What reading the newest sample raises now."""
    try:
        sensor.latest()
    except DeviceError as error:
        return error
    return None


@pytest.mark.parametrize(("fault", "error"), [("silence", Stale), ("nan", Stale), ("stuck", Stuck)])
async def test_a_sensor_that_does_not_measure_is_told_until_it_measures_again(
    fault: str, error: type[DeviceError], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sri_m8123, "STUCK_MS", 100.0)
    board, seen = ForceBoard(lambda: WRENCH, noise_n=0.002, noise_nm=2e-4), list[ForceSample]()
    async with sensing(board, stale_ms=250.0) as sensor:
        sensor.listen(seen.append)
        await until(lambda: len(seen) > 10, "rounds")
        board.next_fault = lambda: fault
        await until(lambda: isinstance(latest_error(sensor), error), "a sample that is refused")
        if fault == "nan":
            await until(lambda: sensor.assembler.refused >= 2, "refused rounds")
        board.next_fault = lambda: None
        await until(lambda: latest_error(sensor) is None, "a new sample")
    for sample in seen:
        assert (*sample.force_n, *sample.torque_nm) == pytest.approx(WRENCH, abs=0.02)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (["bus-off"], r"off after too many errors.*termination.*1000000 bit/s"),
        (can.CanOperationError("network is down", 100), r"bus virtual a board failed: .*connect again"),
        (OSError(19, "No such device"), r"bus virtual a board failed: .*connect again"),
    ],
    ids=["bus off", "network down", "adapter gone"],
)
async def test_a_bus_that_is_off_or_gone_is_a_lost_connection_that_says_what_to_do_and_a_bus_error_is_counted(
    board: ForceBoard, sensor: SriM8123, fault: list[str] | Exception, words: str
):
    board.next_fault = Mock(side_effect=chain(["bus-error"], repeat(None)))
    await until(lambda: sensor.bus_errors == 1, "the driver")
    assert sensor.latest().force_n == WRENCH[:3]
    board.next_fault = Mock(side_effect=fault)
    await until(lambda: readers() == 0, "the driver")
    with pytest.raises(ConnectionLost, match=words):
        sensor.latest()
    with pytest.raises(ConnectionLost):
        await sensor.bias(0.1)


@pytest.mark.parametrize(
    ("interface", "channel", "within_s", "ends"),
    [
        ("virtual", "nobody", 0.2, pytest.raises(DeviceTimeout, match=r"no complete reading in 0.2 s .*termination")),
        ("socketcan", "can9", 60.0, pytest.raises(ConnectionLost, match="cannot open socketcan can9")),
        ("no-such-interface", "can9", 60.0, pytest.raises(ConnectionLost, match="cannot open no-such-interface can9")),
    ],
)
async def test_where_no_board_answers_or_no_adapter_is_there_connecting_says_so(
    interface: str, channel: str, within_s: float, ends: pytest.RaisesExc[DeviceError], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(sri_m8123, "CONNECT_S", within_s)
    sensor = SriM8123(TABLE.model_copy(update={"interface": interface, "channel": channel}), Clock())
    with ends:
        await sensor.connect()
    await sensor.close()
    assert readers() == 0
    with pytest.raises(NotConnected):
        sensor.latest()


async def test_a_bias_is_subtracted_from_now_on():
    load: list[Wrench] = [WRENCH]
    async with sensing(ForceBoard(lambda: load[0], noise_n=0.02, noise_nm=0.002)) as sensor:
        await sensor.bias(0.2)
        assert sensor.bias_wrench == pytest.approx(WRENCH, abs=0.02)
        seen: list[ForceSample] = []
        load[0] = (1.0, -2.0, 8.5, 0.25, -0.5, 0.125)
        sensor.listen(seen.append)
        await until(lambda: len(seen) > 5, "the driver")
        assert seen[-1].force_n == pytest.approx((0.0, 0.0, 5.0), abs=0.1)


@pytest.mark.parametrize(("axis", "size", "says"), [(2, 1.0, "Fz varied"), (3, 0.1, "Mx varied")])
async def test_a_bias_while_something_moves_is_refused(axis: int, size: float, says: str):
    turns = count()

    def shake() -> Wrench:
        swing = size * math.sin(0.5 * next(turns))
        return tuple(v + swing * (k == axis) for k, v in enumerate(WRENCH))

    async with sensing(ForceBoard(shake)) as sensor:
        with pytest.raises(DeviceError, match=rf"{says}.*The previous bias remains.*try again"):
            await sensor.bias(0.2)
        assert sensor.bias_wrench == (0.0,) * 6


async def test_a_bias_over_silence_is_refused_and_closing_ends_one(board: ForceBoard, sensor: SriM8123):
    board.next_fault = lambda: "silence"
    with pytest.raises(DeviceTimeout):
        await sensor.bias(0.2)
    averaging = asyncio.create_task(sensor.bias(0.3))
    await asyncio.sleep(0)
    await sensor.close()
    with pytest.raises(NotConnected, match="closed"):
        await averaging


# ---------------------------------------------------------------- the rounds of the force board


def test_with_frames_lost_or_late_at_random_every_wrench_is_of_one_round(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sri_m8123, "ROUND_S", 0.005)
    rng = random.Random(22)
    for _ in range(500):
        parts, kept, whole = RoundAssembler(), [[rng.random() > 0.3 for _ in range(3)] for _ in range(8)], 0
        assert parts.feed(*encode_round(WRENCH)[2], 0.0) is None
        assert parts.torn == 0, "to join in mid-round is no fault"
        for number, keeps in enumerate(kept):
            for place, frame in enumerate(encode_round((float(number),) * 6)):
                late_s = 0.0 if keeps[place] else rng.choice((-1.0, 0.006, 1e9, math.nan, math.inf))
                lost = not keeps[place] and (place == 0 or rng.random() < 0.5)
                wrench = None if lost else parts.feed(*frame, number * 0.010 + late_s)
                assert wrench is None or set(wrench) == {float(number)}
                whole += wrench is not None
        assert whole == kept.count([True, True, True])
