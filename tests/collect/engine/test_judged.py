"""Captures are judged as they come: a bad stroke is made again elsewhere, then a person decides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.steps import capture as capturing
from brushloop.collect.errors import CollectAborted, NeedsOperator, Parked
from brushloop.collect.quality.checks import Verdict, check_drawing
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.sessions.events import PressResult
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.recording import Recording
from tests.runs import answered_alike, until, wait_for_end

if TYPE_CHECKING:
    from brushloop.calibrate.stroke import Gray
    from brushloop.collect.engine.engine import Engine
    from tests.rigs import Lab


def run(engine: Engine) -> None:
    engine.start()
    wait_for_end(engine)


def used(lab: Lab) -> int:
    [folder] = lab.sessions.iterdir()
    return len(replay(folder / "journal.jsonl").used_patches)


def test_a_split_stroke_is_pressed_again_on_a_new_cell_and_only_the_sound_one_counts(sharp_lab: Lab) -> None:
    sharp_lab.rig.world.flaws[0] = (Flaw.SPLIT, 1.0)
    engine = sharp_lab.engine()
    run(engine)

    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.given_up) == (State.DONE, 1, 0)
    assert any("split" in line.lower() for line in now.messages), now.messages
    assert used(sharp_lab) == 2 + now.voids
    [folder] = sharp_lab.sessions.iterdir()
    [capture] = Recording(folder).captures()
    assert capture.stroke.stroke_id == "H13-a0-r01"
    assert capture.stroke.anchor_mm == pytest.approx(
        (sharp_lab.rig.world.presses[-1].x_mm, sharp_lab.rig.world.presses[-1].y_mm), abs=0.1
    )


def test_a_stroke_that_fails_every_time_is_given_up_where_nobody_watches(sharp_lab: Lab) -> None:
    sharp_lab.rig.world.flaws.update(dict.fromkeys(range(20), (Flaw.SPLIT, 1.0)))
    engine = sharp_lab.engine()
    run(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.given_up) == (State.DONE, 0, 1)
    assert now.eta_s == 0.0, "a stroke that was left out takes no more time"
    assert used(sharp_lab) == 3 + now.voids


def test_a_question_that_nobody_answered_is_asked_again_on_resume(sharp_lab: Lab) -> None:
    sharp_lab.rig.world.flaws.update(dict.fromkeys(range(20), (Flaw.SPLIT, 1.0)))
    left = sharp_lab.engine(watched=True)
    left.start()
    assert until(left, lambda now: now.prompt is not None).state is State.ASKING
    left.park()  # as `q` does, and a lost connection
    with pytest.raises(Parked):
        wait_for_end(left)
    assert left.snapshot().given_up == 0

    resumed = sharp_lab.engine(watched=True)
    questions = answered_alike(resumed, "g")
    assert [question.partition(":")[0] for question in questions[1:]] == ["H13-a0-r01, take 3"]
    assert (resumed.snapshot().strokes_done, resumed.snapshot().given_up) == (1, 0)
    assert len(sharp_lab.rig.world.presses) == 3


def test_an_operator_who_watches_may_keep_it(sharp_lab: Lab) -> None:
    sharp_lab.rig.world.flaws.update(dict.fromkeys(range(20), (Flaw.SPLIT, 1.0)))
    engine = sharp_lab.engine(watched=True)
    [question] = answered_alike(engine, "g")
    assert question.startswith("H13-a0-r01, take 3: ")
    assert (engine.snapshot().strokes_done, engine.snapshot().given_up) == (1, 0)


def test_ink_on_a_cell_that_should_be_blank_is_seen_before_the_brush_is_dipped(sharp_lab: Lab) -> None:
    world = sharp_lab.rig.world
    ink_ml = world.well.ml
    world.paper.lay(world.brush.press(13.0, 0.0, ink_load=1.0, press_seed=5), 31.0, 67.0, 0.0)
    world.version += 1
    with pytest.raises(NeedsOperator, match=r"patches? of sheet 1 that should be blank"):
        run(sharp_lab.engine())
    assert not [press for press in world.presses if press.depth_mm > 1.0]
    assert world.well.ml == ink_ml


def test_a_full_sheet_is_changed_on_the_screen_and_the_run_goes_on(sharp_lab: Lab) -> None:
    text = (sharp_lab.folder / "rig.toml").read_text(encoding="utf-8")
    (sharp_lab.folder / "rig.toml").write_text(
        text.replace("cell_mm = [40.0, 24.0]", "cell_mm = [100.0, 60.0]"), encoding="utf-8"
    )
    sharp_lab.write_protocol("[13.0, 15.0]", "[0.0]")
    engine = sharp_lab.engine(watched=True)
    engine.start()
    prompt = until(engine, lambda now: now.prompt is not None).prompt
    assert prompt is not None
    assert "Sheet 1 is full" in prompt.question
    sharp_lab.rig.world.fresh_sheet()
    assert engine.answer(prompt.number, "g")
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 2


def test_saying_no_to_real_hardware_leaves_it_as_it_is(sharp_lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("brushloop.drivers.arcs.robot.LOOPBACK_CONTROL_BOX", "something else")
    engine = sharp_lab.engine(watched=True)
    with pytest.raises(CollectAborted, match="nothing moved"):
        answered_alike(engine, "x")
    assert sharp_lab.rig.arcs.cabinet.power.mode == "PowerOff"


FIGURE = """kind = "write"
cell_mm = [50.0, 36.0]
[[figures]]
name = "bar"
[[figures.strokes]]
points = [[12.0, 18.0, 5.0, 0.0, 0.0], [37.0, 18.0, 5.0, 0.0, 0.0]]
"""
SHALLOW = """[[figures.strokes]]
points = [[12.0, 26.0, 1.0, 0.0, 0.0], [37.0, 26.0, 1.0, 0.0, 0.0]]
"""


def test_the_peak_force_of_a_figure_is_that_of_its_deepest_stroke(sharp_lab: Lab) -> None:
    (sharp_lab.folder / "protocol.toml").write_text(FIGURE + SHALLOW, encoding="utf-8")
    run(sharp_lab.engine())
    [folder] = sharp_lab.sessions.iterdir()
    [drawn] = replay(folder / JOURNAL_NAME).results(PressResult)
    assert (drawn.peak_force_n or 0.0) > 0.02, "the shallow stroke comes last and reaches 0.007 N"


def test_a_figure_without_ink_is_drawn_again(sharp_lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    (sharp_lab.folder / "protocol.toml").write_text(FIGURE, encoding="utf-8")
    left = [1]

    def blank(image: Gray, *rest: object, **more: object) -> Verdict:
        left[0] -= 1
        return check_drawing(np.full_like(image, 200) if left[0] >= 0 else image, *rest, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(capturing, "check_drawing", blank)
    engine = sharp_lab.engine()
    run(engine)
    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.given_up) == (State.DONE, 1, 0)
    assert used(sharp_lab) == 2
    [folder] = sharp_lab.sessions.iterdir()
    assert [capture.stroke.stroke_id for capture in Recording(folder).captures()] == ["bar-r01"]
