"""A second client of the controller, as a pendant or a forgotten script is one: nothing that it did is missed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.errors import CollectAborted
from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.motion import until_settled
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import MotionFailed, PathDisturbed, SettingsChanged
from brushloop.drivers.geometry import brush_pose, from_wire, lean, to_wire
from brushloop.sessions.events import PressResult
from tests.collect.sent import noting
from tests.rigs import Lab
from tests.runs import ended_by, question, until, wait_for_end

PAPER_Z_MM, SAFE_Z_MM = 120.0, 180.0
UNDER = brush_pose(480.0, 40.0, PAPER_Z_MM - 20.0, tilt_deg=10.0)
"""20 mm under the paper, leaning."""


def pause_after(engine: Engine, strokes: int = 1) -> None:
    until(engine, lambda now: now.strokes_done == strokes)
    engine.pause()
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
    engine.resume()
    pause_after(engine, 2)
    assert_up_along_the_tool_first(sent)
    [warning] = [line for line in engine.snapshot().messages if "from where it was left" in line]
    assert warning.startswith("warning: ")

    second_client(lab, engine, brush_pose(480.0, 40.0, 250.0, tilt_deg=60.0))
    sent.clear()
    engine.resume()
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
    moved = until(engine, lambda now: now.prompt is not None and now.prompt.number != jog.number).prompt
    assert moved is not None
    assert "from where it was left" in moved.question
    assert not sent, "nothing moves before a person has looked"
    engine.answer(moved.number, "g")
    until(engine, lambda now: now.prompt is not None and now.prompt.number not in (jog.number, moved.number))
    assert_up_along_the_tool_first(sent)
    engine.stop()
    ended_by(engine, CollectAborted)


SHORTER = {"RobotConfig_setTcpOffset": {"offset": [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]}}
"""10 mm short: every press would be 10 mm deeper than it says."""


def up_slowly(lab: Lab) -> dict[str, Any]:
    here = lab.rig.world.tool()
    up = to_wire(dataclasses.replace(here, z_mm=here.z_mm + 30.0))
    return {"MotionControl_moveLine": {"pose": up, "a": 1.0, "v": 0.00005, "blend_radius": 0.0, "duration": 0.0}}


def test_what_a_second_client_did_in_a_pause_is_asked_about_before_anything_moves_and_then_set_right(lab: Lab) -> None:
    lab.write_protocol("[11.0]", "[0.0]", repeats=4)
    engine = lab.started(on_screen=True)
    acts: list[tuple[Callable[[Lab], dict[str, Any]], str]] = [
        (up_slowly, "the arm is moving, and not from here"),
        (lambda _: {"RobotManage_poweroff": {}}, "robot mode is not Running"),
        (lambda _: SHORTER, "tool offset is (0, 0, 170) mm"),
    ]
    for done, (calls, asks) in enumerate(acts, 1):
        pause_after(engine, done)
        second_client(lab, engine, **calls(lab))
        sent = lines_sent(lab)
        engine.resume()
        prompt = question(engine, asks)
        assert prompt.default == "x"
        assert not sent
        engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 4
    assert lab.rig.arcs.cabinet.tcp_offset[2] == 0.18
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
        if into_paper and not sent and world.motion.held and world.motion.size:
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
