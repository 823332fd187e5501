"""The engine on the loopback rig: every stroke exactly once, whatever interrupts it, and how a session goes on; and
nothing is missed that a second client of the controller did."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import UNCHECKED, Engine
from brushloop.collect.errors import CollectAborted, ConfigError, NeedsOperator, SheetFull
from brushloop.drivers.arcs.controller import Controller, SafetyMode
from brushloop.drivers.arcs.motion import until_settled
from brushloop.drivers.devices import Identity, Pose
from brushloop.drivers.errors import DeviceError, MotionFailed, PathDisturbed, SettingsChanged
from brushloop.drivers.geometry import brush_pose, from_wire, lean, to_wire
from brushloop.drivers.sim.scene import Scene
from brushloop.sessions.events import CaptureResult, PressResult
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Topic
from brushloop.sessions.store import SessionStore
from tests.collect.sent import noting
from tests.rigs import SMALL_VIEW, Lab
from tests.runs import answer, answered_alike, ended_by, question, until, wait_for_end

ELSEWHERE = replace(SMALL_VIEW, centre_mm=(SMALL_VIEW.centre_mm[0] + 3.0, SMALL_VIEW.centre_mm[1]))


def test_a_whole_session_is_collected_as_the_protocol_says_and_merged(lab: Lab) -> None:
    lab.write_protocol(tilts="[0.0, 10.0]")
    lab.edit_rig("", "\n[self_check]\nenabled = false\n")
    now = lab.run(armed=True).snapshot()
    recording = Recording(lab.session)
    assert (now.state, now.strokes_done, now.strokes_planned, now.force_ceiling_n) == (State.DONE, 4, 4, 5.0)
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
    assert [0.02 < peak_n < 0.5 for peak_n in peaks_n] == [True] * 4


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
    again = question(engine, mode, after=first.number)
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
        with pytest.raises(ConfigError, match=r"--dry-run.*must lie in \[25, 44.97\] mm"):
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


# A second client of the controller, as a pendant or a forgotten script is one

PAPER_Z_MM, SAFE_Z_MM = 120.0, 180.0
UNDER = brush_pose(480.0, 40.0, PAPER_Z_MM - 20.0, tilt_deg=10.0)
"""20 mm under the paper, leaning."""


def pause_after(engine: Engine, strokes: int = 1) -> None:
    until(engine, lambda now: now.strokes_done == strokes)
    engine.control.pause()
    until(engine, lambda now: now.state is State.PAUSED)


def second_client(lab: Lab, engine: Engine, target: Pose | None = None, **calls: dict[str, Any]) -> None:
    """Sets what it is asked to set, then moves the arm, without any limits."""

    async def act() -> None:
        client = Controller(lab.rig.address, lab.rig.arcs.port)
        client.robot = "rob1"
        await client.open()
        try:
            for method, params in calls.items():
                assert await client.ask(method.replace("_", "."), **params) == 0
            if target is not None:
                await client.move_line(target, 200.0, 800.0)
                await until_settled(client.rest, target, planned_s=5.0)
        finally:
            await client.close()

    engine.meanwhile(act())


def lines_sent(lab: Lab) -> list[Pose]:
    """Every line from here on that reaches the arm."""
    sent: list[Pose] = []
    noting(lab.rig.world.motion, sent.append)
    return sent


def assert_up_along_the_tool_first(sent: list[Pose]) -> None:
    up = sent[0]
    assert up.z_mm == pytest.approx(SAFE_Z_MM, abs=0.01)
    risen_mm = SAFE_Z_MM - UNDER.z_mm
    assert up.x_mm - UNDER.x_mm == pytest.approx(risen_mm * 0.17632698, abs=0.05)  # tan 10 deg
    assert up.y_mm == pytest.approx(UNDER.y_mm, abs=0.05)
    assert lean(up)[0] == pytest.approx(10.0, abs=0.05)


def test_an_arm_that_was_moved_in_a_pause_first_goes_up_along_its_tool_once_it_is_within_its_limits(lab: Lab) -> None:
    lab.write_protocol("[11.0]", "[0.0]", repeats=3)
    engine, sent = lab.started(on_screen=True), lines_sent(lab)
    pause_after(engine)
    second_client(lab, engine, UNDER)
    sent.clear()
    engine.control.resume()
    pause_after(engine, 2)
    assert_up_along_the_tool_first(sent)
    [warning] = [line for line in engine.snapshot().messages if "from where it was left" in line]
    assert warning.startswith("warning: ")

    second_client(lab, engine, brush_pose(480.0, 40.0, 250.0, tilt_deg=60.0))
    sent.clear()
    engine.control.resume()
    prompt = question(engine, "the arm stands where tilt = 60.000 deg")
    assert "Jog the arm up" in prompt.question
    assert not sent
    second_client(lab, engine, UNDER)
    sent.clear()
    engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert_up_along_the_tool_first(sent)
    assert engine.snapshot().strokes_done == 3


def test_an_arm_that_was_moved_at_a_question_first_goes_up_along_its_tool(lab: Lab) -> None:
    """A jog asks at every step, with the brush near the paper."""
    lab.edit_rig("", '\n[touch]\nmethod = "jog"\ntouches = 1\n')
    engine = lab.started(on_screen=True)
    jog = question(engine, "Jog until")
    second_client(lab, engine, UNDER)
    sent = lines_sent(lab)
    engine.answer(jog.number, "3")
    moved = question(engine, "from where it was left", after=jog.number)
    assert not sent, "nothing moves before a person has looked"
    engine.answer(moved.number, "g")
    question(engine, after=moved.number)
    assert_up_along_the_tool_first(sent)
    engine.stop()
    ended_by(engine, CollectAborted)


SHORTER = {"RobotConfig_setTcpOffset": {"offset": [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]}}
"""10 mm short: every press would be 10 mm deeper than it says."""


def up_slowly(lab: Lab) -> dict[str, Any]:
    here = lab.rig.world.tool()
    up = to_wire(replace(here, z_mm=here.z_mm + 30.0))
    return {"MotionControl_moveLine": {"pose": up, "a": 1.0, "v": 0.00005, "blend_radius": 0.0, "duration": 0.0}}


def test_what_a_second_client_did_in_a_pause_is_asked_about_before_anything_moves_and_then_set_right(lab: Lab) -> None:
    lab.write_protocol("[11.0]", "[0.0]", repeats=4)
    engine = lab.started(on_screen=True)
    acts: list[tuple[Callable[[Lab], dict[str, Any]], str]] = [
        (up_slowly, "the arm is moving, but brushloop does not move it"),
        (lambda _: {"RobotManage_poweroff": {}}, "robot mode is not Running"),
        (lambda _: SHORTER, "tool offset is (0, 0, 170) mm"),
    ]
    for done, (calls, asks) in enumerate(acts, 1):
        pause_after(engine, done)
        second_client(lab, engine, **calls(lab))
        sent = lines_sent(lab)
        engine.control.resume()
        prompt = question(engine, asks)
        assert prompt.default == "x"
        assert not sent
        engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert (engine.snapshot().strokes_done, lab.rig.arcs.cabinet.tcp_offset[2]) == (4, 0.18)
    assert max(press.depth_mm for press in lab.rig.world.presses) < 11.1, "none went deeper than asked"


def test_a_tool_offset_that_changes_after_the_last_look_leaves_a_void_and_no_stroke(lab: Lab) -> None:
    """Between the driver's look and the controller's own reading of the line there is always a moment."""
    lab.write_protocol("[11.0]", "[0.0]")
    methods = lab.rig.arcs._methods
    move_line = methods["rob1.MotionControl.moveLine"]

    def tampered(params: dict[str, Any]) -> Any:
        if from_wire(params["pose"]).z_mm == pytest.approx(PAPER_Z_MM + 0.03 - 11.0, abs=0.01):
            lab.rig.arcs.cabinet.tcp_offset = [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]
        return move_line(params)

    methods["rob1.MotionControl.moveLine"] = tampered
    with pytest.raises((SettingsChanged, MotionFailed)):
        lab.run()
    assert "press" in {begin.kind for begin, _ in lab.state.cut}
    assert not lab.state.results(PressResult)
    assert lab.engines[-1].snapshot().strokes_done == 0


@pytest.mark.parametrize("moment", ["moveLine", "startMove"], ids=["between our lines", "as the path is released"])
def test_a_press_with_another_clients_line_is_void_lifted_and_made_again_on_a_new_patch(lab: Lab, moment: str) -> None:
    lab.write_protocol("[11.0]", "[0.0]")
    methods, world = lab.rig.arcs._methods, lab.rig.world
    method = f"rob1.MotionControl.{moment}"
    carry_out = methods[method]
    sent: list[bool] = []

    def tampered(params: dict[str, Any]) -> Any:
        into_paper = moment == "startMove" or from_wire(params["pose"]).z_mm < PAPER_Z_MM - 10.0
        if into_paper and not sent and world.motion.held and world.motion.size(world.clock.now_s()):
            sent.append(world.motion.add(UNDER, 200.0, 800.0, world.clock.now_s()))
        return carry_out(params)

    methods[method] = tampered
    engine = lab.started()
    ended_by(engine, PathDisturbed, "nother client")
    now = engine.snapshot()
    assert sent == [True]
    assert (now.state, now.strokes_done, now.rest_unknown, now.parked) == (State.FAILED, 0, False, True)
    # A line that comes with the release follows the lift: a busy computer may be late to stop it.
    assert moment == "startMove" or not world.drags

    methods[method] = carry_out
    again = lab.run()
    assert len(lab.state.used_patches) == 2
    assert any("nother client" in why for _, why in lab.state.cut)
    assert again.snapshot().strokes_done == 1
