"""An adaptive session: the next press depends on the ink so far, and a killed one goes on with the same choices."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from pydantic import ValidationError

from calibrate.fit.stepwise import CapturedPress, Design, field_grid, next_cell, packed, unpacked
from collect.planning.limit_check import check_protocol
from collect.planning.summary import make_plan
from collect.protocols.adaptive import AdaptiveConfig
from collect.protocols.config import load_protocol
from collect.protocols.steps import Result, Step, StepKind
from collect.rig.config import load_rig
from model.fitted import FittedPress
from sessions.journal.journal import JOURNAL_NAME, replay
from sessions.journal.lines import read_lines
from sessions.reader import Recording
from tests.collect.until import wait_for_end
from tests.waiting import PATIENCE_S, wait_until

if TYPE_CHECKING:
    from conftest import Lab

HEIGHTS, TILTS = [11.0, 15.0, 19.0], [0.0, 10.0]
CELLS = tuple((h, a) for h in HEIGHTS for a in TILTS)
PROTOCOL = (
    f'kind = "adaptive"\nheights_mm = {HEIGHTS}\ntilts_deg = {TILTS}\nrepeats = 3\nmost_presses = 7\n'
    "least_presses = 3\nenough_points = {enough}\ndwell_s = 0.0\n"
)


def config(**changed: Any) -> AdaptiveConfig:
    return AdaptiveConfig(**({"kind": "adaptive", "heights_mm": HEIGHTS, "tilts_deg": TILTS, "repeats": 3} | changed))


def walked(made: AdaptiveConfig, choices: dict[int, Result]) -> list[Step]:
    """The steps when each CHOOSE is answered from `choices`, else with nothing, as a plan is walked."""
    seen: list[Step] = []
    generator = made.steps()
    answer: Result | None = None
    try:
        while True:
            step = next(generator) if answer is None else generator.send(answer)
            seen.append(step)
            answer = choices.get(step.index, {}) if step.kind is StepKind.CHOOSE else {"sheet": 0, "cell": 3}
    except StopIteration:
        return seen


def ink_of(brush: FittedPress, height_mm: float, tilt_deg: float) -> str:
    """A press of that brush as a capture would tell it."""
    from calibrate.fit.stepwise import FIELD

    centres = (np.arange(768) + 0.5) * 0.05
    left, top = FIELD.anchor_mm
    return packed(brush.chance(height_mm, tilt_deg, centres - left, top - centres, 0.15) > 0.5)


def test_what_is_pressed_is_what_was_chosen_and_a_stop_ends_it() -> None:
    choice = {"stop": False, "number": 0, "height_mm": 19.0, "tilt_deg": 10.0}
    seen = walked(config(), {0: choice, 1: {"stop": True, "number": 1}})
    kinds = [step.kind for step in seen]
    cycle = [StepKind.CHOOSE, StepKind.DIP, StepKind.PRESS, StepKind.CAPTURE]
    assert kinds == [StepKind.ZERO_TOUCH, StepKind.BOARD, *cycle, StepKind.CHOOSE]
    assert seen[4].params["height_mm"] == 19.0
    assert seen[4].params["stroke_id"] == "001-H19-a10"
    assert seen[5].params["measured"] is True


def test_a_plan_is_the_worst_case_and_reaches_every_cell() -> None:
    made = config(most_presses=8)
    pressed = [step for step in walked(made, {}) if step.kind is StepKind.PRESS]
    assert len(pressed) == len(made.planned()) == 8
    assert {(s.params["height_mm"], s.params["tilt_deg"]) for s in pressed} == set(CELLS)
    assert len({step.key for step in walked(made, {})}) == len(walked(made, {}))


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("most_presses", 5, "at least the 6 cells"),
        ("least_presses", 19, "at most most_presses = 18"),
        ("heights_mm", [11.0, 11.0], "the same value twice"),
        ("enough_points", 0.0, "greater than 0"),
    ],
)
def test_what_cannot_be_is_refused(field: str, value: object, says: str) -> None:
    with pytest.raises(ValidationError, match=says):
        config(**{field: value})


def test_ink_comes_back_from_text_and_nothing_else_is_taken_for_it() -> None:
    brush = FittedPress(6.0, 48.0)
    text = ink_of(brush, 15.0, 5.0)
    grid = field_grid()
    wanted = brush.chance(15.0, 5.0, grid.x_mm, grid.y_mm, 0.15) > 0.5
    assert np.count_nonzero((unpacked(text) > 0.5) != wanted) < 0.02 * np.count_nonzero(wanted)
    assert len(text) < 2000
    for bad in ("", "!", "aGVsbG8="):
        with pytest.raises(ValueError, match=r"ink of a press|reshape"):
            unpacked(bad)


def test_a_choice_depends_on_the_ink_and_on_nothing_else() -> None:
    design = Design(6.0, 48.0, CELLS, 1.0, 3)
    brush = FittedPress(6.0, 48.0)
    seen = [CapturedPress(h, a, ink_of(brush, h, a)) for h, a in CELLS[:2]]
    assert next_cell(design, seen) == next_cell(design, seen)
    fat = FittedPress(6.0, 48.0, brush.values * np.where(np.arange(len(brush.values)) == 0, 1.5, 1.0))
    other = [CapturedPress(h, a, ink_of(fat, h, a)) for h, a in CELLS[:2]]
    assert next_cell(design, other).points_after != next_cell(design, seen).points_after
    assert next_cell(design, other).ink_sha256 != next_cell(design, seen).ink_sha256


def test_a_cell_that_shows_no_stroke_twice_is_not_chosen_again() -> None:
    design = Design(6.0, 48.0, CELLS, 1.0, 3)
    first = next_cell(design, []).cell
    assert first is not None
    failed = [CapturedPress(*first, "")] * 2
    assert next_cell(design, failed[:1]).cell == first
    assert next_cell(design, failed).cell != first
    everywhere = [CapturedPress(h, a, "") for h, a in CELLS for _ in range(2)]
    stopped = next_cell(design, everywhere)
    assert stopped.cell is None
    assert "no cell is left" in stopped.why


def test_a_rig_pc_chooses_without_torch() -> None:
    code = "import sys, collect.engine.steps.choose, calibrate.fit.stepwise; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE_S).returncode == 0


def adaptive_lab(lab: Lab, enough: float) -> Lab:
    (lab.folder / "protocol.toml").write_text(PROTOCOL.replace("{enough}", f"{enough}"), encoding="utf-8")
    return lab


def choices(lab: Lab) -> list[dict[str, Any]]:
    [folder] = lab.sessions.iterdir()
    state = replay(folder / JOURNAL_NAME)
    return [line["result"] for line in state.segments if line["kind"] == "choose"]


def test_the_plan_of_a_rig_shows_the_worst_case(lab: Lab) -> None:
    adaptive_lab(lab, 5.0)
    rig_path, path = lab.folder / "rig.toml", lab.folder / "protocol.toml"
    rig, protocol = load_rig(rig_path), load_protocol(path)
    check_protocol(rig_path, path, rig, protocol)
    plan = make_plan(rig, protocol)
    assert (len(plan.placed), plan.dips, plan.kind) == (7, 7, "adaptive")
    assert any("worst case" in warning for warning in plan.warnings)


def test_a_session_stops_when_enough_is_known_and_says_what_it_saved(lab: Lab) -> None:
    engine = adaptive_lab(lab, 45.0).engine()
    engine.start()
    wait_for_end(engine)
    *made, last = choices(lab)
    assert last["stop"]
    assert len(made) == 3  # least_presses
    assert last["saved"] == 18 - 3
    now = engine.snapshot()
    assert (now.strokes_done, now.strokes_planned) == (3, 3)
    assert any("15 of the 18 presses of the shuffled grid were saved" in line for line in now.messages)
    [folder] = lab.sessions.iterdir()
    pressed = [(c.stroke.height_mm, c.stroke.tilt_deg) for c in Recording(folder).captures()]
    assert pressed == [(c["height_mm"], c["tilt_deg"]) for c in made]
    assert all(c["strokes"] == k for k, c in enumerate(made))


@pytest.mark.soak
def test_killed_again_and_again_it_presses_each_choice_once(lab: Lab) -> None:
    """kill -9 in mid press, after a capture, and while choosing: what was chosen stays chosen."""
    adaptive_lab(lab, 0.01)
    before = len(lab.rig.world.presses)
    known: list[dict[str, Any]] = []
    for moment in ("press", "capture", "choose"):
        process = lab.process()
        wait_for(lab, moment, process)
        process.kill()
        process.communicate()
        now = choices(lab)
        assert now[: len(known)] == known, "an earlier choice changed"
        known = now
    process = lab.process()
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, stderr
    *made, last = choices(lab)
    assert made[: len(known)] == known
    assert len(made) == 7
    assert "most_presses" in last["why"]
    [folder] = lab.sessions.iterdir()
    recording = Recording(folder)
    strokes = [c.stroke for c in recording.captures()]
    assert [s.stroke_id for s in strokes] == [
        f"{k + 1:03d}-H{c['height_mm']:g}-a{c['tilt_deg']:g}" for k, c in enumerate(made)
    ]
    state = replay(folder / JOURNAL_NAME)
    deep = [p for p in lab.rig.world.presses[before:] if p.depth_mm > 1.0]
    places = {(round(p.x_mm), round(p.y_mm)) for p in deep}
    assert len(places) == len(deep), "a cell was pressed twice"
    assert len(deep) <= len(state.used_cells)
    assert len({(s.anchor_mm) for s in strokes}) == 7


def wait_for(lab: Lab, kind: str, process: subprocess.Popen[str]) -> None:
    """Until a step of that kind begins that had not begun when this was called."""

    def begun() -> int:
        lines = [line for path in lab.sessions.glob(f"*/{JOURNAL_NAME}") for line in read_lines(path)]
        return sum(1 for line in lines if line["event"] == "begin" and line["kind"] == kind)

    known = begun()
    wait_until(lambda: begun() > known + (kind == "choose"), f"a step {kind}", process=process)
