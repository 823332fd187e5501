"""The engine on the loopback rig: every stroke exactly once, whatever interrupts it, and how a session goes on."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import UNCHECKED
from brushloop.collect.errors import CollectAborted, ConfigError, NeedsOperator, SheetFull
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.sim.scene import Scene
from brushloop.sessions.events import CaptureResult, PressResult
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Topic
from brushloop.sessions.store import SessionStore
from tests.rigs import SMALL_VIEW, Lab
from tests.runs import answer, answered_alike, ended_by, question, until, wait_for_end

ELSEWHERE = replace(SMALL_VIEW, centre_mm=(SMALL_VIEW.centre_mm[0] + 3.0, SMALL_VIEW.centre_mm[1]))


def test_a_whole_session_is_collected_as_the_protocol_says_and_merged(lab: Lab) -> None:
    lab.write_protocol(tilts="[0.0, 10.0]")
    lab.edit_rig("", "\n[self_check]\nenabled = false\n")
    now = lab.run(armed=True).snapshot()
    recording = Recording(lab.session)
    assert (now.state, now.strokes_done, now.strokes_planned) == (State.DONE, 4, 4)
    assert now.source == recording.header.source == "loopback rig"
    captures = sorted(recording.captures(), key=lambda capture: capture.stroke.still)
    assert all(capture.image().shape == (384, 512) for capture in captures)
    assert {(c.stroke.depth_mm, c.stroke.tilt_deg) for c in captures} == {(11, 0), (11, 10), (15, 0), (15, 10)}
    # World's own answer sheet; the operator taught the touch height .03 mm too high. The first contact is zero touch.
    for press, stroke in zip(lab.presses, (capture.stroke for capture in captures), strict=True):
        assert stroke.depth_mm == pytest.approx(press.depth_mm + 0.03, abs=0.01)
        assert (stroke.tilt_deg, 0.0) == pytest.approx((press.tilt_deg, press.heading_deg), abs=0.01)
        assert stroke.anchor_mm == pytest.approx((press.x_mm, press.y_mm), abs=0.05)
        assert press.ink_load == 1.0
    assert any(UNCHECKED in line for line in now.messages), "it was armed, and its self-check is switched off"
    assert "self_check" not in {step.kind for step in lab.state.files.values()}
    with pytest.raises(ConfigError, match="Put a fresh sheet in, then confirm it with --sheet 1"):
        lab.engine()

    # Force and ink are recorded beside the poses.
    with recording.path.open("rb") as file:
        seen = Counter(channel.topic for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages())
    assert min(seen[topic] for topic in (Topic.TCP, Topic.JOINTS, Topic.WRENCH)) > 10
    assert seen[Topic.INK] == 4
    peaks_n = [press.peak_force_n or 0.0 for press in lab.state.results(PressResult)]
    assert len(peaks_n) == 4
    assert all(0.02 < peak_n < 0.5 for peak_n in peaks_n)


def test_stop_in_mid_press_voids_the_patch_and_the_same_command_goes_on(lab: Lab) -> None:
    """Who has asked to park does not have to wait for the end of the press; nor who stops before anything has moved."""
    engine = lab.engine()
    engine.stop()
    engine.start()
    ended_by(engine, CollectAborted)
    assert engine.snapshot().state == State.STOPPED
    for parked_before in (True, False):
        engine = lab.started()
        until(engine, lambda now: now.strokes_done == 1)
        until(engine, lambda now: now.step.startswith("press") and now.tip_mm is not None and now.tip_mm[2] < 125.0)
        if parked_before:
            engine.park()
        engine.stop()
        engine.stop()
        ended_by(engine, CollectAborted)
        assert engine.snapshot().state == State.STOPPED
        assert lab.at_rest

    lab.run()
    state = lab.state
    assert len(state.cut) == 2
    # The cut presses burnt their patches: four presses (two of them cut) touched four places.
    assert len(state.used_patches) == 4
    strokes = list(Recording(lab.session).stroke_records())
    assert len({stroke.stroke_id for stroke in strokes}) == len(strokes) == 2
    assert [s.reached_mm for s in strokes] == [capture.press.reached_mm for capture in state.results(CaptureResult)]
    assert [s.reached_mm for s in strokes] == pytest.approx([s.depth_mm for s in strokes], abs=0.2)


def test_a_full_sheet_asks_for_a_fresh_one_and_goes_on_with_it(lab: Lab) -> None:
    lab.edit_rig("cell_mm = [40.0, 24.0]", "cell_mm = [120.0, 150.0]")
    lab.write_protocol("[11.0, 12.0, 13.0, 14.0, 15.0]")  # 5 presses, 2 patches
    with pytest.raises(SheetFull, match="--sheet 2"):
        lab.run()
    assert [*lab.state.files.values()][-1].kind == "capture", "no brush was dipped for a sheet that was full"
    assert not [begin.kind for begin, _ in lab.state.cut if begin.kind == "dip"]
    engine = lab.started(sheet=2)
    until(engine, lambda now: now.strokes_done == 3)
    engine.stop()
    ended_by(engine, CollectAborted)
    with pytest.raises(ConfigError, match="only 2 or 3"):
        lab.run(sheet=5)
    engine = lab.started(sheet=2, on_screen=True)  # the same command again: the sheet is not changed twice
    answer(engine, "Resume", "g")
    answer(engine, "Sheet 2 is full", "g")
    wait_for_end(engine)
    assert sum(1 for _ in Recording(lab.session).captures()) == 5
    presses = sum(lab.state.attempts[step.key] for step in lab.state.files.values() if step.kind == "press")
    assert len(lab.state.used_patches) == presses, "no patch is used twice"
    assert {sheet for sheet, _ in lab.state.used_patches} == {0, 1, 2}


def test_real_hardware_is_not_moved_unless_armed_or_allowed_on_the_screen(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("brushloop.drivers.arcs.robot.LOOPBACK_CONTROL_BOX", "something else")
    with pytest.raises(ConfigError, match=r"real hardware.*--arm"):
        lab.run()
    with pytest.raises(CollectAborted, match="nothing moved"):
        answered_alike(lab.engine(on_screen=True), "x")
    assert not lab.sessions.exists()
    assert lab.rig.arcs.cabinet.power.mode == "PowerOff"


# How a session goes on


def begun(lab: Lab) -> Path:
    """The folder of a session that was parked after its first stroke."""
    engine = lab.started()
    until(engine, lambda now: now.strokes_done == 1)
    engine.park()
    ended_by(engine, CollectAborted, "parked")
    return lab.session


def test_who_resumes_on_a_screen_is_asked_before_anything_moves(lab: Lab) -> None:
    folder = begun(lab)
    before = lab.rig.world.tool(), (folder / JOURNAL_NAME).read_bytes()
    for leaves in (False, True):
        engine = lab.started(on_screen=True)
        prompt = question(engine, "parked on request")
        assert engine.snapshot().state is State.ASKING
        assert folder.name in prompt.question
        engine.park() if leaves else engine.answer(prompt.number, "x")
        ended_by(engine, CollectAborted, "nothing moved")
        assert (lab.rig.world.tool(), (folder / JOURNAL_NAME).read_bytes()) == before

    SessionStore(folder, lambda: 1).release()  # as a process that is killed
    engine = lab.engine(on_screen=True)
    [asked] = answered_alike(engine, "g")
    assert "cut off" in asked
    assert engine.snapshot().strokes_done == 2


def test_a_session_goes_on_only_with_the_rig_that_it_was_begun_on(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, pressed, config = begun(lab), lab.presses, lab.rig.config
    for view, said in ((replace(SMALL_VIEW, width_px=640, height_px=480), "640 x 480 px"), (ELSEWHERE, r"3\.\d mm")):
        lab.rig.config = lab.rig.world.config = replace(config, view=view)
        lab.rig.scene = Scene(lab.rig.world)
        with pytest.raises(NeedsOperator, match=said):
            lab.run()
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.drivers.arcs.robot.Identity", lambda _model, *rest: Identity("another arm", *rest))
        with pytest.raises(ConfigError, match="was begun on"):
            lab.run(armed=True)
    lab.edit_rig(f"port = {lab.rig.arcs.port}", "port = 1")
    engine = lab.started(on_screen=True)
    ended_by(engine, DeviceError)
    now = engine.snapshot()
    assert (now.state, now.session_id, now.folder) == (State.FAILED, folder.name, str(folder)), "it is still named"
    assert lab.presses == pressed


# A run that is held, and one that only moves


def test_a_safety_stop_holds_the_session_until_a_person_has_released_it(lab: Lab) -> None:
    """An answer before that is asked again and moves nothing."""
    mode = SafetyMode.PROTECTIVE_STOP
    lab.edit_rig("press_speed_mm_s = 20.0", "press_speed_mm_s = 2.0")
    lab.write_protocol("[11.0]", "[0.0]")
    engine, power = lab.engine(on_screen=True), lab.rig.arcs.cabinet.power
    engine.start()
    until(engine, lambda _: lab.rig.world.tool().z_mm <= 117.0)
    lab.rig.arcs.cabinet.safety_stop(mode)
    first = question(engine, mode)
    assert first.default == "x"
    assert engine.snapshot().state is State.ASKING
    where = lab.rig.world.tool()
    assert engine.answer(first.number, "g")
    again = until(engine, lambda now: now.prompt is not None and now.prompt.number != first.number).prompt
    assert again is not None
    assert mode in again.question
    assert lab.rig.world.tool() == where
    assert power.safety == mode, "nothing is ever cleared automatically"

    power.safety = SafetyMode.NORMAL  # a person, at the pendant
    assert engine.answer(again.number, "g")
    wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.voids) == (State.DONE, 1, 1)


def test_a_dry_run_moves_all_the_way_and_leaves_neither_ink_nor_session(lab: Lab) -> None:
    """One too low or too high is refused with the range."""
    lab.write_protocol("[11.0, 20.0]")
    for depth_mm in (24.0, 46.0):
        with pytest.raises(ConfigError, match=r"--dry-run.*outside \[25, 44.97\] mm"):
            lab.engine(dry_run_mm=depth_mm)
    well_ml = lab.rig.world.well.ml
    ran = lab.command("--dry-run", "30")
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == "dry run done; nothing was kept\n"
    assert "dry run: nothing is pressed, dipped or kept" in ran.stderr
    assert "dry run: every move was made" in ran.stderr
    assert "session" not in ran.stderr
    assert not lab.sessions.exists()
    assert not lab.rig.world.presses
    assert lab.rig.world.well.ml == well_ml
    assert lab.at_rest
