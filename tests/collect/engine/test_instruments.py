"""Force sensor and ink station in a session: what they stop, what they fill, and what is recorded of them."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pytest
from mcap.reader import make_reader

from brushloop.collect.engine.control import State
from brushloop.collect.errors import ForceTooHigh, PosesLate
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.errors import ConnectionLost, Stuck
from brushloop.drivers.ink.port import DoseLost, InkRefused
from brushloop.drivers.sim.faults import Device, Fault
from brushloop.sessions.events import DipResult, PressResult
from brushloop.sessions.journal import RunState, replay
from brushloop.sessions.records import Topic
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from pathlib import Path

    from brushloop.collect.engine.engine import Engine
    from tests.collect.conftest import Collected
    from tests.rigs import Lab


def run(engine: Engine) -> None:
    engine.start()
    wait_for_end(engine)


def only_session(lab: Lab) -> Path:
    [folder] = lab.sessions.iterdir()
    return folder


def state_of(lab: Lab) -> RunState:
    return replay(only_session(lab) / "journal.jsonl")


def slowly(lab: Lab) -> None:
    """Presses of seconds, so that there is time to act in their middle at the rig's pace."""
    path = lab.folder / "rig.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("press_speed_mm_s = 20.0", "press_speed_mm_s = 2.0"))
    lab.write_protocol("[11.0]", "[0.0]")
    protocol = lab.folder / "protocol.toml"
    protocol.write_text(protocol.read_text(encoding="utf-8").replace("dwell_s = 0.0", "dwell_s = 60.0"))


def at_rest(lab: Lab) -> bool:
    world = lab.rig.world
    return world.motion.steady(world.clock.now_s() + 1.0)


@pytest.mark.xdist_group("collected")
def test_force_ink_and_their_cadence_are_recorded_beside_the_poses(collected: Collected) -> None:
    folder = collected.folder
    with (folder / f"{folder.name}.mcap").open("rb") as file:
        seen = Counter(channel.topic for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages())
    assert min(seen[topic] for topic in (Topic.TCP, Topic.JOINTS, Topic.WRENCH, Topic.CADENCE)) > 10
    assert seen[Topic.INK] == 4
    peaks_n = [press.peak_force_n or 0.0 for press in state_of(collected.lab).results(PressResult)]
    assert len(peaks_n) == 4
    assert all(0.02 < peak_n < 0.5 for peak_n in peaks_n)


def test_something_hard_under_the_brush_stops_the_arm_at_once_and_burns_the_cell(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lab.rig.world.reaction, "push_n", lambda depth_mm, _tilt_deg: 9.0 if depth_mm > 4.0 else 0.0)
    slowly(lab)
    engine = lab.engine()
    with pytest.raises(ForceTooHigh, match="ceiling is 5 N"):
        run(engine)

    assert engine.snapshot().state == State.FAILED
    assert at_rest(lab)
    # It was stopped on its way down, and not moved away from what it met: a person must look first.
    assert 120.0 - 11.0 <= lab.rig.world.tool().z_mm < 116.0
    state = replay(only_session(lab) / "journal.jsonl")
    assert (len(state.cut), len(state.used_patches)) == (1, 1)


def test_a_sensor_that_goes_silent_in_mid_press_stops_the_arm_and_the_press_is_done_again_elsewhere(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_n = lab.rig.world.reaction.push_n
    silenced: list[float] = []

    def silent_once(depth_mm: float, tilt_deg: float) -> float:
        if depth_mm > 4.0 and not silenced:
            silenced.append(depth_mm)
            lab.rig.faults.hang(Fault(device=Device.FORCE, kind="silence", for_s=20.0))
        return push_n(depth_mm, tilt_deg)

    monkeypatch.setattr(lab.rig.world.reaction, "push_n", silent_once)
    text = (lab.folder / "rig.toml").read_text(encoding="utf-8").replace("stale_ms = 1000.0", "stale_ms = 600.0")
    (lab.folder / "rig.toml").write_text(text, encoding="utf-8")
    slowly(lab)
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.voids > 0)
    lab.rig.faults.clear()
    wait_for_end(engine)

    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.voids) == (State.DONE, 1, 1)
    assert any("newest sample" in line for line in now.messages)


def test_a_sensor_that_is_stuck_in_mid_press_stops_the_arm_and_ends_the_run_with_its_name(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    push_n = lab.rig.world.reaction.push_n
    stuck: list[float] = []

    def stick_once(depth_mm: float, tilt_deg: float) -> float:
        if depth_mm > 2.0 and not stuck:
            stuck.append(depth_mm)
            lab.rig.faults.hang(Fault(device=Device.FORCE, kind="stuck", for_s=2.0))
        return push_n(depth_mm, tilt_deg)

    monkeypatch.setattr(lab.rig.world.reaction, "push_n", stick_once)
    slowly(lab)
    with pytest.raises(Stuck, match="the sensor is stuck"):
        run(lab.engine())
    state = replay(only_session(lab) / "journal.jsonl")
    assert (len(state.cut), len(state.used_patches)) == (1, 1)
    assert at_rest(lab)
    assert lab.rig.world.tool().z_mm > 170.0, "a sensor is at fault, the arm is in order: the brush was lifted"


def test_a_bus_that_goes_off_ends_the_run_with_the_arm_parked(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    push_n = lab.rig.world.reaction.push_n

    def off(depth_mm: float, tilt_deg: float) -> float:
        if depth_mm > 4.0:
            lab.rig.faults.hang(Fault(device=Device.FORCE, kind="bus-off"))
        return push_n(depth_mm, tilt_deg)

    monkeypatch.setattr(lab.rig.world.reaction, "push_n", off)
    with pytest.raises(ConnectionLost, match="is off after too many errors"):
        run(lab.engine())
    assert at_rest(lab)
    assert lab.rig.world.tool().z_mm > 170.0


def test_a_low_well_is_filled_before_the_brush_dips(lab: Lab) -> None:
    well = lab.rig.world.well
    well.ml = 0.4 * well.capacity_ml
    run(lab.engine())
    assert well.share > 0.45
    dips = state_of(lab).results(DipResult)
    assert all(dip.ink_level is not None and dip.ink_level >= 0.5 for dip in dips)
    assert max(dip.dosed_ml or 0.0 for dip in dips) >= 1.0


def test_an_empty_reservoir_ends_the_run_before_a_dry_press(lab: Lab) -> None:
    lab.rig.world.well.ml = 1.0
    assert lab.rig.ink is not None
    lab.rig.ink.instrument.reservoir_ml = 0.2  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(InkRefused, match="Refill the reservoir"):
        run(lab.engine())
    assert at_rest(lab)
    assert lab.rig.world.tool().z_mm > 170.0
    assert not [press for press in lab.rig.world.presses if press.depth_mm > 1.0]


def test_a_dose_that_does_not_arrive_is_the_operators_to_mend(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    lab.rig.world.well.ml = 1.0
    monkeypatch.setattr(lab.rig.world.well, "add", lambda _volume_ml: None)  # the tube has come off
    with pytest.raises(DoseLost, match="Look at the tube"):
        run(lab.engine())
    assert not [press for press in lab.rig.world.presses if press.depth_mm > 1.0]


def test_poses_that_come_late_end_the_run_before_a_press_counts(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AuboArcs, "pose_lag_ms", lambda _: 412.0)
    with pytest.raises(PosesLate, match="max_pose_lag_ms = 100") as caught:
        run(lab.engine())
    assert caught.value.lag_ms == 412.0
    state = replay(only_session(lab) / "journal.jsonl")
    assert len(state.cut) == 1
    assert not state.results(PressResult)
