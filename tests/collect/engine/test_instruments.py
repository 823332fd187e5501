"""Force sensor and ink station in a session: what they stop, what they fill, and what is recorded of them."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.recorder import ForceGuard, Recorder
from brushloop.collect.errors import ForceTooHigh, NeedsOperator, arm_at_fault, describe, rest_is_unknown
from brushloop.collect.motion import Procedures
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import ForceSample, Stamp
from brushloop.drivers.errors import ConnectionLost, DeviceError, MotionFailed, Stuck
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import DoseLost
from brushloop.drivers.sim import world
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.sessions.events import DipResult, PressResult
from brushloop.sessions.mcap_writer import Outgoing
from tests.rigs import Lab
from tests.runs import SteppedEngine, answer, ended_by, question, until, wait_for_end


def slowly(lab: Lab) -> None:
    """Presses of seconds, so that there is time to act in their middle at the rig's pace."""
    lab.edit_rig("press_speed_mm_s = 20.0", "press_speed_mm_s = 2.0")
    lab.write_protocol("[11.0]", "[0.0]", dwell_s=60.0)


def in_mid_press(lab: Lab) -> SteppedEngine:
    """A run that stands still with the brush 4 mm deep."""
    slowly(lab)
    engine = lab.started()
    until(engine, lambda _: lab.rig.world.tool().z_mm < 116.0)
    return engine


def test_something_hard_under_the_brush_stops_the_arm_at_once_and_burns_the_patch(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world, "push_on", lambda _brush: lambda depth_mm, _tilt_deg: 9.0 if depth_mm > 4.0 else 0.0)
    slowly(lab)
    with pytest.raises(ForceTooHigh, match="ceiling is 5 N"):
        lab.run()
    assert lab.engines[-1].snapshot().state == State.FAILED
    assert lab.at_rest
    # It was stopped on its way down, and not moved away from what it met: a person must look first.
    assert 120.0 - 11.0 <= lab.rig.world.tool().z_mm < 116.0
    assert (len(lab.state.cut), len(lab.state.used_patches)) == (1, 1)


def test_a_sensor_that_goes_silent_in_mid_press_stops_the_arm_and_the_press_is_done_again_elsewhere(lab: Lab) -> None:
    lab.edit_rig("stale_ms = 1000.0", "stale_ms = 600.0")
    engine = in_mid_press(lab)
    lab.rig.faults.hang(Fault(device=Device.FORCE, kind="silence", for_s=20.0))
    until(engine, lambda now: now.voids > 0)
    lab.rig.faults.clear()
    wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.voids) == (State.DONE, 1, 1)
    assert any("newest sample" in line for line in now.messages)


@pytest.mark.parametrize(
    ("fault", "error", "says"),
    [
        (Fault(device=Device.FORCE, kind="stuck", for_s=2.0), Stuck, "the sensor is stuck"),
        (Fault(device=Device.FORCE, kind="bus-off"), ConnectionLost, "is off after too many errors"),
    ],
)
def test_a_sensor_that_fails_in_mid_press_ends_the_run_with_the_brush_lifted(
    lab: Lab, fault: Fault, error: type[Exception], says: str
) -> None:
    engine = in_mid_press(lab)
    lab.rig.faults.hang(fault)
    ended_by(engine, error, says)
    assert (len(lab.state.cut), len(lab.state.used_patches)) == (1, 1)
    assert lab.at_rest
    assert lab.rig.world.tool().z_mm > 170.0, "a sensor is at fault, the arm is in order"


def test_a_low_well_is_filled_before_the_brush_dips_and_nothing_is_pressed_until_the_ink_has_come(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert lab.rig.ink is not None
    firmware: Any = lab.rig.ink.instrument
    well = lab.rig.world.well
    well.ml = 1.0
    with monkeypatch.context() as tube:
        tube.setattr(well, "add", lambda _volume_ml: None)  # it has come off
        with pytest.raises(DoseLost, match="Look at the tube"):
            lab.run()
    firmware.reservoir_ml = 0.2
    engine = lab.started(on_screen=True)
    answer(engine, "Resume", "g")
    prompt = question(engine, "Refill the reservoir")
    assert not lab.presses
    assert lab.rig.world.tool().z_mm > 170.0, "a person is about to reach under the arm"
    firmware.reservoir_ml = 100.0
    assert engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert len(lab.presses) == 2
    assert well.share > 0.45
    dips = lab.state.results(DipResult)
    assert all(dip.ink_level is not None and dip.ink_level >= 0.5 for dip in dips)
    assert max(dip.dosed_ml or 0.0 for dip in dips) >= 1.0


@pytest.mark.parametrize("watched", [False, True])
def test_poses_that_come_late_end_the_run_and_whoever_must_act_is_told_that_the_brush_could_not_be_lifted(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, watched: bool
) -> None:
    retreats, retreat = list[Procedures](), Procedures.retreat

    async def only_once(self: Procedures) -> None:
        if retreats:
            raise MotionFailed("robot", "moveLine", "did not arrive")
        retreats.append(self)
        await retreat(self)

    monkeypatch.setattr(Procedures, "retreat", only_once)
    monkeypatch.setattr(AuboArcs, "pose_lag_ms", lambda _: 412.0)
    engine = lab.started(on_screen=watched)
    if watched:
        answer(engine, "could not be lifted", "x")
    late = ended_by(engine, NeedsOperator, "arrive 412 ms late")
    assert "could not be lifted: robot: moveLine: did not arrive" in describe(late)
    assert len(lab.state.cut) == 1
    assert not lab.state.results(PressResult), "no press counts"


# The force ceiling: what is under way ends with the stop, and nothing is sent after it


class Cell:
    """An arm whose lines end at once and whose stops take a while, and a sensor that a test speaks for."""

    def __init__(self) -> None:
        self.did: list[str] = []
        self.say: Callable[[ForceSample], None] = lambda _: None

    def listen(self, on_sample: Callable[[ForceSample], None] | None) -> None:
        self.say = on_sample or (lambda _: None)

    def latest(self) -> None:
        pass

    async def move(self) -> None:
        self.did.append("line")
        await asyncio.sleep(0.0)

    async def stop(self) -> None:
        self.did.append("stop")
        await asyncio.sleep(0.05)
        self.did.append("at rest")

    async def press_too_hard(self) -> None:
        """Move down step by step, guarded, with 6 N from the third line on where 5 N are allowed."""
        rig: Any = SimpleNamespace(robot=self, force=self, config=SimpleNamespace(force=SimpleNamespace(max_n=5.0)))
        guard = ForceGuard(rig)
        self.listen(guard.sample)

        async def down_step_by_step() -> None:
            while True:
                await self.move()
                if len(self.did) == 3:
                    self.say(ForceSample(Stamp(1), (0.0, 0.0, 6.0), (0.0, 0.0, 0.0)))

        await guard.guarded(down_step_by_step())


async def test_no_line_is_sent_after_the_stop_for_too_much_force() -> None:
    cell = Cell()
    with pytest.raises(ForceTooHigh, match=r"reached 6\.00 N"):
        await cell.press_too_hard()
    assert cell.did[cell.did.index("stop") :] == ["stop", "at rest"]


async def test_where_the_stop_fails_too_the_force_is_named_first_and_the_arm_counts_as_moving() -> None:
    class Runaway(Cell):
        async def stop(self) -> None:
            raise MotionFailed("robot", "stop", "not seen at rest", condition="The arm may still be moving.")

    with pytest.raises(DeviceError) as caught:
        await Runaway().press_too_hard()
    told = describe(caught.value)
    assert told.index("6.00 N") < told.index("The arm may still be moving.")
    assert rest_is_unknown(caught.value)
    assert arm_at_fault(caught.value)


# The two times of a sample: when the host got it, and when the device took it, both by the host's clock

MS = 1_000_000
SECOND = 1000 * MS


def delays_ms(ahead_ns: list[int], delays: list[int]) -> list[float]:
    """How much earlier than the host got it each force was taken, as recorded.

    The device's clock is this far ahead of the host's, and the samples took so many ms to arrive.
    """
    kept: list[Outgoing] = []
    recorder = Recorder(cast(Any, SimpleNamespace(write=kept.append)), Clock())
    for number, (ahead, delay_ms) in enumerate(zip(ahead_ns, delays, strict=True)):
        taken_ns = 1_700_000_000 * SECOND + number * 10 * MS
        stamp = Stamp(taken_ns + delay_ms * MS, taken_ns + ahead, number)
        recorder.force(ForceSample(stamp, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)))
        assert kept[-1].log_ns == stamp.host_ns
    return [(message.log_ns - message.publish_ns) / MS for message in kept]


@pytest.mark.parametrize("ahead_s", [-1_700_000_000, -3, 0, 5])
def test_the_time_of_a_device_is_told_by_the_hosts_clock_and_never_after_its_arrival(ahead_s: int):
    delays = [4, 2, 9, 2, 30]
    assert delays_ms([ahead_s * SECOND] * 5, delays) == [0.0, 0.0, 7.0, 0.0, 28.0], "beyond the quickest so far"
    began_anew = (ahead_s - 4000) * SECOND
    assert delays_ms([ahead_s * SECOND] * 2 + [began_anew] * 2, [2, 3, 3, 5]) == [0.0, 1.0, 0.0, 2.0], "mapped anew"
