"""The engine on the loopback rig: every stroke exactly once, whatever interrupts it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import UNCHECKED, Engine
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import CollectAborted, ConfigError
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import RobotNotSafe
from brushloop.sessions.events import CaptureResult
from brushloop.sessions.journal import replay
from brushloop.sessions.recording import Recording
from tests.journal_lines import read_lines
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from tests.collect.conftest import Collected
    from tests.rigs import Lab


def run(engine: Engine) -> None:
    engine.start()
    wait_for_end(engine)


def run_and_stop(engine: Engine, when: Callable[[Snapshot], bool]) -> None:
    engine.start()
    until(engine, when)
    engine.stop()
    with pytest.raises(CollectAborted):
        wait_for_end(engine)


@pytest.mark.xdist_group("collected")
def test_a_whole_session_is_collected_merged_and_reported(collected: Collected) -> None:
    now = collected.engine.snapshot()
    assert (now.state, now.strokes_done, now.strokes_planned) == (State.DONE, 4, 4)
    assert now.source == "loopback rig"
    recording = Recording(collected.folder)
    assert recording.header.source == "loopback rig"
    captures = list(recording.captures())
    assert sorted((c.stroke.depth_mm, c.stroke.tilt_deg) for c in captures) == [(11, 0), (11, 10), (15, 0), (15, 10)]
    assert all(c.image().shape == (384, 512) for c in captures)


@pytest.mark.xdist_group("collected")
def test_the_arm_presses_what_the_protocol_says_where_the_cell_lies(collected: Collected) -> None:
    # World's own answer sheet; the operator taught the touch height .03 mm too high. The first contact is zero touch.
    strokes = {c.stroke.still: c.stroke for c in Recording(collected.folder).captures()}
    pressed = [p for p in collected.lab.rig.world.presses if p.depth_mm > 1.0]
    for press, stroke in zip(pressed, (strokes[k] for k in sorted(strokes)), strict=True):
        assert stroke.depth_mm == pytest.approx(press.depth_mm + 0.03, abs=0.01)
        assert stroke.tilt_deg == pytest.approx(press.tilt_deg, abs=0.01)
        assert stroke.anchor_mm == pytest.approx((press.x_mm, press.y_mm), abs=0.05)
        assert press.heading_deg == pytest.approx(0.0, abs=0.01)
        assert press.ink_load == 1.0


def test_stop_in_mid_press_voids_the_cell_and_the_same_command_goes_on(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    until(engine, lambda now: now.step.startswith("press") and now.tip_mm is not None and now.tip_mm[2] < 125.0)
    engine.stop()
    engine.stop()
    with pytest.raises(CollectAborted):
        wait_for_end(engine)
    assert engine.snapshot().state == State.STOPPED
    stopped_at = lab.rig.world.tool()
    time.sleep(0.1)
    assert lab.rig.world.tool() == stopped_at

    again = lab.engine()
    run(again)

    [folder] = lab.sessions.iterdir()
    state = replay(folder / "journal.jsonl")
    assert state.cut
    ids = [c.stroke.stroke_id for c in Recording(folder).captures()]
    assert len(ids) == len(set(ids)) == 2
    # The cut press burnt its patch: three presses (one of them cut) touched three places.
    assert len(state.used_patches) == 3
    strokes = list(Recording(folder).stroke_records())
    pressed = [capture.press for capture in state.results(CaptureResult)]
    assert [stroke.reached_mm for stroke in strokes] == [press.reached_mm for press in pressed]
    assert all(abs((stroke.reached_mm or 0.0) - (stroke.depth_mm or 0.0)) < 0.2 for stroke in strokes)


def test_stop_before_anything_has_moved(lab: Lab) -> None:
    engine = lab.engine()
    engine.stop()
    engine.start()
    with pytest.raises(CollectAborted):
        wait_for_end(engine)
    assert engine.snapshot().state == State.STOPPED


def test_pause_waits_between_steps_and_resume_goes_on(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    engine.pause()
    paused = until(engine, lambda now: now.state == State.PAUSED)
    time.sleep(0.2)
    assert engine.snapshot().strokes_done == paused.strokes_done
    engine.resume()
    wait_for_end(engine)
    assert engine.snapshot().state == State.DONE


def test_stop_works_while_paused(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.state == State.RUNNING)
    engine.pause()
    until(engine, lambda now: now.state == State.PAUSED)
    engine.stop()
    with pytest.raises(CollectAborted):
        wait_for_end(engine)


def test_a_protective_stop_ends_the_run_and_says_what_to_do(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.step.startswith("press"))
    lab.rig.arcs.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe, match="pendant"):
        wait_for_end(engine)
    now = engine.snapshot()
    assert now.state == State.FAILED
    assert "ProtectiveStop" in now.error
    assert lab.rig.arcs.cabinet.power.safety == SafetyMode.PROTECTIVE_STOP, "nothing is ever cleared automatically"


def test_a_changed_protocol_is_refused_with_the_difference(lab: Lab) -> None:
    run_and_stop(lab.engine(), lambda now: now.strokes_done == 1)

    lab.write_protocol(heights="[11.0, 16.0]")
    with pytest.raises(ConfigError, match=r"(?s)protocol.toml: depths_mm: \[11.0, 15.0\] -> \[11.0, 16.0\]\n.*--new"):
        lab.engine()
    with pytest.raises(ConfigError, match="--sheet 1"):
        lab.engine(new=True)
    run(lab.engine(new=True, sheet=1))
    assert len(list(lab.sessions.iterdir())) == 2


def test_a_full_sheet_asks_for_a_fresh_one_and_goes_on_with_it(lab: Lab) -> None:
    text = (lab.folder / "rig.toml").read_text().replace("cell_mm = [40.0, 24.0]", "cell_mm = [120.0, 80.0]")
    (lab.folder / "rig.toml").write_text(text)
    lab.write_protocol("[11.0, 13.0, 15.0]", "[0.0, 10.0]")  # 6 presses, 4 patches

    from brushloop.collect.errors import SheetFull

    with pytest.raises(SheetFull, match="--sheet 2"):
        run(lab.engine())
    [folder] = lab.sessions.iterdir()
    begun = [line["kind"] for line in read_lines(folder / "journal.jsonl") if line["event"] == "begin"]
    assert begun[-1] == "capture", "no brush was dipped for a sheet that was full"
    run_and_stop(lab.engine(sheet=2), lambda now: now.strokes_done == 5)
    with pytest.raises(ConfigError, match="only 2 or 3"):
        run(lab.engine(sheet=5))
    run(lab.engine(sheet=2))  # the same command again: the sheet is not changed twice
    [folder] = lab.sessions.iterdir()
    assert sum(1 for _ in Recording(folder).captures()) == 6
    lines = [line for line in read_lines(folder / "journal.jsonl") if line["event"] == "begin"]
    pressed = [(line["sheet"], patch) for line in lines for patch in line.get("patches", [])]
    assert len(pressed) == len(set(pressed))
    assert {sheet for sheet, _ in pressed} == {0, 1}


def test_a_sheet_is_not_changed_while_a_press_on_it_waits_for_its_photograph(lab: Lab) -> None:
    run_and_stop(lab.engine(), lambda now: now.step.startswith("capture"))
    with pytest.raises(ConfigError, match=r"is pressed on sheet 1 but not photographed"):
        run(lab.engine(sheet=2))
    run(lab.engine())


@pytest.mark.xdist_group("collected")
def test_a_finished_session_is_not_followed_by_another_on_the_same_sheet(collected: Collected) -> None:
    with pytest.raises(ConfigError, match="Put a fresh sheet in, then confirm it with --sheet 1"):
        collected.lab.engine()
    assert len(list(collected.lab.sessions.iterdir())) == 1


def test_what_the_environment_changes_is_recorded_and_held_against_a_resume(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BRUSHLOOP_PAPER__TOUCH_Z_MM", "121.0")
    run_and_stop(lab.engine(), lambda now: now.strokes_done == 1)
    [folder] = lab.sessions.iterdir()
    assert '"touch_z_mm": 121.0' in (folder / "rig.effective.json").read_text()
    monkeypatch.delenv("BRUSHLOOP_PAPER__TOUCH_Z_MM")
    with pytest.raises(ConfigError, match=r"rig.toml: paper.touch_z_mm: 121.0 -> 120.03\n.*in the same environment;"):
        lab.engine()


def test_real_hardware_is_not_moved_unless_armed(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.drivers.arcs.robot.LOOPBACK_CONTROL_BOX", "something else")
    with pytest.raises(ConfigError, match=r"real hardware.*--arm"):
        run(lab.engine())
    assert not lab.sessions.exists()
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"


def test_an_armed_run_without_its_self_check_says_so(lab: Lab) -> None:
    lab.write_protocol("[11.0]", "[0.0]")
    lab.edit_rig("", "\n[self_check]\nenabled = false\n")
    engine = lab.run(armed=True)
    assert any(UNCHECKED in line for line in engine.snapshot().messages)
    assert "self_check" not in {step.kind for step in replay(next(lab.sessions.glob("*/journal.jsonl"))).files.values()}


def test_a_session_is_not_resumed_on_another_robot(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    run_and_stop(lab.engine(), lambda now: now.strokes_done == 1)
    monkeypatch.setattr(
        "brushloop.drivers.arcs.robot.Identity", lambda device, _model, *rest: Identity(device, "another arm", *rest)
    )
    with pytest.raises(ConfigError, match="was begun on"):
        run(lab.engine(armed=True))
