"""A run that is held: by the arm's safety system, by an empty reservoir; and one that only moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.errors import ConfigError
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.errors import RobotNotSafe
from tests.command import brushloop
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from pathlib import Path

    from brushloop.collect.engine.engine import Engine
    from brushloop.collect.operator import Prompt
    from tests.rigs import Lab


def slowly(lab: Lab) -> None:
    path = lab.folder / "rig.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("press_speed_mm_s = 20.0", "press_speed_mm_s = 2.0"))
    lab.write_protocol("[11.0]", "[0.0]")


def asked(engine: Engine) -> Prompt:
    prompt = until(engine, lambda now: now.prompt is not None).prompt
    assert prompt is not None
    return prompt


def pressing(lab: Lab, engine: Engine) -> None:
    until(engine, lambda _now: lab.rig.world.tool().z_mm <= 117.0)


@pytest.mark.parametrize(
    "mode", [SafetyMode.PROTECTIVE_STOP, pytest.param(SafetyMode.SAFEGUARD_STOP, marks=pytest.mark.soak)]
)
def test_a_safety_stop_holds_the_session_until_a_person_has_released_it(lab: Lab, mode: SafetyMode) -> None:
    slowly(lab)
    engine = lab.engine(watched=True)
    engine.start()
    pressing(lab, engine)
    lab.rig.arcs.cabinet.safety_stop(mode)

    prompt = asked(engine)
    assert mode in prompt.question
    assert prompt.default == "x"
    assert engine.snapshot().state is State.ASKING
    lab.rig.arcs.cabinet.power.safety = SafetyMode.NORMAL  # a person, at the pendant
    assert engine.answer(prompt.number, "g")
    wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.voids) == (State.DONE, 1, 1)


def test_an_answer_before_the_stop_is_released_is_asked_again_and_moves_nothing(lab: Lab) -> None:
    slowly(lab)
    engine = lab.engine(watched=True)
    engine.start()
    pressing(lab, engine)
    lab.rig.arcs.cabinet.safety_stop()
    first = asked(engine)
    where = lab.rig.world.tool()
    assert engine.answer(first.number, "g")
    second = until(engine, lambda now: now.prompt is not None and now.prompt.number != first.number).prompt
    assert second is not None
    assert "ProtectiveStop" in second.question
    assert lab.rig.world.tool() == where
    assert engine.answer(second.number, "x")
    with pytest.raises(RobotNotSafe):
        wait_for_end(engine)
    assert lab.rig.world.tool() == where


def test_a_refilled_reservoir_lets_the_run_go_on(lab: Lab) -> None:
    lab.write_protocol("[11.0]", "[0.0]")
    lab.rig.world.well.ml = 4.0
    assert lab.rig.ink is not None
    firmware = lab.rig.ink.instrument
    firmware.reservoir_ml = 0.2  # pyright: ignore[reportAttributeAccessIssue]
    engine = lab.engine(watched=True)
    engine.start()
    prompt = asked(engine)
    assert "Refill the reservoir" in prompt.question
    assert lab.rig.world.tool().z_mm > 170.0  # a person is about to reach under the arm
    firmware.reservoir_ml = 100.0  # pyright: ignore[reportAttributeAccessIssue]
    assert engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 1


def test_a_dry_run_moves_all_the_way_and_leaves_neither_ink_nor_session(lab: Lab) -> None:
    lab.write_protocol("[11.0, 20.0]", "[0.0, 10.0]")
    well_ml = lab.rig.world.well.ml
    ran = brushloop("collect", "--no-tui", "--dry-run", "30", *lab.options)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout == "dry run done; nothing was kept\n"
    assert "dry run: nothing is pressed, dipped or kept" in ran.stderr
    assert "dry run: every move was made" in ran.stderr
    assert "brushloop-dry-" not in ran.stderr
    assert "session" not in ran.stderr
    assert not lab.sessions.exists()
    assert not lab.rig.world.presses
    assert lab.rig.world.well.ml == well_ml
    assert lab.rig.world.motion.exec_id(lab.rig.world.clock.now_s()) == -1


@pytest.mark.parametrize("depth_mm", [24.0, 46.0])
def test_a_dry_run_too_low_or_too_high_is_refused_with_the_range(lab: Lab, tmp_path: Path, depth_mm: float) -> None:
    lab.write_protocol("[20.0]", "[0.0]")
    with pytest.raises(ConfigError, match=r"--dry-run.*outside \[25, 44.97\] mm"):
        Opening.load(tmp_path / "out", lab.folder / "rig.toml", lab.folder / "protocol.toml", dry_run_mm=depth_mm)
