"""From the dip to the decision on a photograph: every press is made alike, the arm sets out for the next dip while a
photograph is judged, a bad stroke is made again elsewhere, then a person decides; and what a screen shows of it."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

from brushloop.calibrate.board.pix2len import see_board
from brushloop.calibrate.calibrated import calibrate_session
from brushloop.calibrate.commands import CalibrateRequest
from brushloop.calibrate.compare import KEYS, Alignment, Tone, simulated
from brushloop.collect.engine import brush as brush_steps
from brushloop.collect.engine import capture as capturing
from brushloop.collect.engine.capture import mark_of
from brushloop.collect.engine.control import State
from brushloop.collect.engine.recorder import RunContext, meanwhile
from brushloop.collect.engine.snapshot import LastCapture
from brushloop.collect.errors import BadPicture, CollectAborted, ConfigError, NeedsOperator, StepError
from brushloop.collect.motion import Procedures, dip_moves, wash_moves
from brushloop.collect.photograph.photographer import Photographer
from brushloop.collect.rig.config import load_rig
from brushloop.collect.tui.review_screen import Review
from brushloop.model.fitted import FittedPress
from brushloop.model.strokes import stroke_model
from brushloop.sessions.events import Press, PressResult, SelfCheckResult
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Condition, Topic
from tests.calibrate.given import kept_lens
from tests.calibrate.simulated_rigs import boards
from tests.rigs import WASH, WIPE, Lab
from tests.runs import answered_alike, ended_by, until, wait_for_end


@pytest.fixture
def went(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the arm did, one after the other."""
    names: list[str] = []
    doers = (Procedures, "set_out"), (Procedures, "dip"), (Procedures, "press"), (Photographer, "photograph")
    for doer, name in doers:
        method = getattr(doer, name)

        async def noted(*arguments: Any, _name: str = name, _method: Any = method) -> Any:
            names.append(_name)
            return await _method(*arguments)

        monkeypatch.setattr(doer, name, noted)
    return names


def test_nobody_looks_at_the_paper_between_dip_and_press(sharp_lab: Lab, went: list[str]) -> None:
    sharp_lab.run()
    assert went[went.index("dip") :] == ["dip", "press", "photograph"]
    [wait_s] = [made.press.dip_to_touch_s for made in sharp_lab.state.results(PressResult)]
    assert wait_s is not None
    assert wait_s > 0.0
    [stroke] = Recording(sharp_lab.session).stroke_records()
    assert stroke.dip_to_touch_s == wait_s
    assert [seen.press.dip_to_touch_s for seen in Review(sharp_lab.session).captures] == [wait_s]


def test_a_brush_that_waited_with_its_ink_dips_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, went: list[str]
) -> None:
    """A pause between dip and press is as good as any length: every wait counts as too long here."""
    monkeypatch.setattr(brush_steps, "STALE_INK_S", 0.0)
    lab.write_protocol("[11.0]", "[0.0]")
    lab.run()
    assert went[went.index("dip") :] == ["dip", "dip", "press", "photograph"]


# The arm goes where the next dip begins; the decision on a photograph still comes before the dip


def test_the_arm_sets_out_for_the_next_dip_while_a_capture_is_judged_and_dips_after_the_decision(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, went: list[str]
) -> None:
    engine, look = lab.engine(), capturing._looked_at

    async def once_under_way(*arguments: Any) -> Any:
        async with asyncio.timeout(10.0):
            while engine.snapshot().strokes_done == 0 and engine.snapshot().parked:
                await asyncio.sleep(0.001)
        seen = await look(*arguments)
        went.append("judged")
        return seen

    monkeypatch.setattr(capturing, "_looked_at", once_under_way)
    engine.start()
    wait_for_end(engine)
    first = ["dip", "press", "photograph", "set_out", "judged"]
    last = ["dip", "press", "photograph", "judged"]
    assert went[went.index("dip") :] == first + last, "nor does the arm set out after the last stroke"
    assert engine.snapshot().parked


def test_a_stop_while_a_capture_is_judged_costs_a_photograph_and_no_press(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    judging = asyncio.Event()

    async def for_ever(*_: Any) -> Any:
        judging.set()
        await asyncio.Event().wait()

    with monkeypatch.context() as patch:
        patch.setattr(capturing, "_looked_at", for_ever)
        engine = lab.started()
        until(engine, lambda _: judging.is_set())
        engine.stop()
        ended_by(engine, CollectAborted)
    assert [begin.kind for begin, _ in lab.state.cut] == ["capture"]

    again = lab.run()
    assert again.snapshot().strokes_done == len(lab.presses) == 2


async def test_a_photograph_at_fault_does_not_stop_the_arm_on_its_way_and_a_failed_motion_is_reported_first() -> None:
    arrived: list[bool] = []

    async def moving() -> None:
        await asyncio.sleep(0.01)
        arrived.append(True)

    async def failing(error: Exception) -> None:
        raise error

    with pytest.raises(BadPicture):
        await meanwhile(moving(), failing(BadPicture("too dark")))
    assert arrived
    with pytest.raises(RuntimeError, match="protective stop"):
        await meanwhile(failing(RuntimeError("protective stop")), failing(BadPicture("too dark")))


# Across the rim, and into water


def test_the_brush_leaves_the_well_across_its_rim_and_is_washed_so_often(lab: Lab) -> None:
    plain = dip_moves(load_rig(lab.folder / "rig.toml"))
    lab.edit_rig("", WIPE + WASH)
    config = load_rig(lab.folder / "rig.toml")
    wiped = dip_moves(config)
    assert [m.target for m in wiped[:2]] == [m.target for m in plain[:2]]
    assert [round(m.target.z_mm) for m in wiped] == [180, 122, 130, 130, 180]
    assert wiped[-1].target.position_mm[:2] == pytest.approx(wiped[-2].target.position_mm[:2])
    assert wiped[-1].target.position_mm[:2] != pytest.approx(plain[-1].target.position_mm[:2])
    assert config.ink.wash is not None
    assert [round(m.target.z_mm) for m in wash_moves(config, config.ink.wash)] == [180, 125, 152, 125, 152, 180]


# Captures are judged as they come, through the camera's lens


def test_a_split_stroke_is_pressed_again_elsewhere_until_it_is_sound_or_given_up_where_nobody_watches(
    sharp_lab: Lab,
) -> None:
    """The first stroke of two is split every time, the other one at first."""
    sharp_lab.rig.world.splits.update(dict.fromkeys(range(4), 1.0))
    sharp_lab.write_protocol("[13.0]", "[0.0]", repeats=2)
    engine = sharp_lab.run()

    now = engine.snapshot()
    assert (now.state, now.strokes_done, now.given_up) == (State.DONE, 1, 1)
    assert now.eta_s == 0.0, "a stroke that was left out takes no more time"
    assert any("split" in line.lower() for line in now.messages), now.messages
    assert len(sharp_lab.state.used_patches) == 5 + now.voids
    [stroke], last = Recording(sharp_lab.session).stroke_records(), sharp_lab.rig.world.presses[-1]
    assert stroke.stroke_id == "H13-a0-r02"
    assert stroke.anchor_mm == pytest.approx((last.x_mm, last.y_mm), abs=0.1)


def test_a_question_that_nobody_answered_is_asked_again_on_resume(sharp_lab: Lab) -> None:
    sharp_lab.rig.world.splits.update(dict.fromkeys(range(20), 1.0))
    left = sharp_lab.started(on_screen=True)
    assert until(left, lambda now: now.prompt is not None).state is State.ASKING
    left.park()  # as `q` does, and a lost connection
    ended_by(left, CollectAborted, "parked")
    assert (left.snapshot().given_up, left.snapshot().prompt) == (0, None)

    resumed = sharp_lab.engine(on_screen=True)
    questions = answered_alike(resumed, "g")
    assert [question.partition(":")[0] for question in questions[1:]] == ["H13-a0-r01, take 3"]
    assert (resumed.snapshot().strokes_done, resumed.snapshot().given_up) == (1, 0)
    assert len(sharp_lab.rig.world.presses) == 3


def test_ink_on_a_patch_that_should_be_blank_is_seen_before_the_brush_is_dipped(sharp_lab: Lab) -> None:
    world = sharp_lab.rig.world
    ink_ml = world.well.ml
    world.paper.lay(world.brush.press(13.0, 0.0, ink_load=1.0, press_seed=5), 31.0, 67.0, 0.0)
    world.version += 1
    with pytest.raises(NeedsOperator, match=r"ink on patches of sheet 1 that should be blank"):
        sharp_lab.run()
    assert not sharp_lab.presses
    assert world.well.ml == ink_ml


# A camera that distorts, with its lens file

K1 = -0.08


def with_lens_file(lab: Lab) -> Path:
    """A lens file beside rig.toml, which names it."""
    path = kept_lens(lab.folder / "camera", (1024, 768), K1)
    lab.edit_rig("[camera]", f'[camera]\nlens_file = "{path.relative_to(lab.folder)}"')
    return path


def test_a_session_is_collected_straight_and_holds_its_lens(bent_lab: Lab) -> None:
    lens = with_lens_file(bent_lab)
    bent_lab.edit_rig("", "\n[self_check]\nenabled = true\n")
    bent_lab.run()
    folder = bent_lab.session
    [(schema, _, message)] = McapFile(Recording(folder).path).messages([str(Topic.CALIBRATION)])
    recorded = CameraCalibration.FromString(message.data)
    assert schema is not None
    assert (schema.name, recorded.width, recorded.height) == ("foxglove.CameraCalibration", 1024, 768)
    assert (list(recorded.D), recorded.K[0]) == ([K1, 0.0, 0.0, 0.0, 0.0], 1024.0)

    # The review looks through the recorded lens: the file that rig.toml names does not lie beside its snapshot.
    review = Review(folder)
    looked = review.pictures(next(capture for capture in review.captures if capture.counts))
    assert looked.binary is not None
    assert looked.binary.any()

    made = calibrate_session(CalibrateRequest(folder)).calibration
    assert made.lens is not None
    assert made.lens.source == f"lens file {lens.stem}"

    # The self-check spent three patches far apart, and the press lies on a fourth.
    state = bent_lab.state
    [check] = state.results(SelfCheckResult)
    assert check.patches == (0, 5, 36)
    assert check.scale == pytest.approx((1.0, 1.0), abs=0.005)
    assert {(0, 0), (0, 5), (0, 36), (0, 1)} <= state.used_patches
    assert len(state.used_patches) == 4 + 3 * len(state.cut)


def test_without_its_lens_file_the_run_ends_before_ink_and_names_the_remedy(bent_lab: Lab) -> None:
    with pytest.raises(StepError, match=r"the lens bends straight lines: .*camera\.lens_file"):
        bent_lab.run()
    assert not bent_lab.state.used_patches
    lens = with_lens_file(bent_lab)
    lens.write_text(lens.read_text().replace("a board", "another"))
    with pytest.raises(ConfigError, match=r"rig.toml: camera.lens_file: .*was edited"):
        bent_lab.run()


def test_a_board_that_moved_is_searched_again_and_one_that_is_hidden_lies_where_it_was_seen_last() -> None:
    [shot] = boards(0, 1)
    first = see_board(shot.image, shot.board)
    run: Any = SimpleNamespace(board=first, rig=SimpleNamespace(config=SimpleNamespace(board=shot.board)))
    hidden, dimmed = np.full_like(shot.image, 90), (0.7 * shot.image).astype(np.uint8)
    assert [RunContext.image_plane(run, image) for image in (hidden, dimmed)] == 2 * [first.plane]
    # By a square diagonally and by two to the side, corners lie on corners; only the markers differ.
    square_px = round(first.square_px)
    for right, down in ((1, 0), (0, -1), (square_px, square_px), (-2 * square_px, 0)):
        moved = np.roll(shot.image, (down, right), axis=(0, 1))
        [was, now] = (plane.to_image(np.zeros((1, 2))) for plane in (first.plane, RunContext.image_plane(run, moved)))
        assert now - was == pytest.approx(np.array([[right, down]]), abs=0.1)
        assert RunContext.image_plane(run, hidden) is run.board.plane


# What a screen shows of a capture, without torch

BRUSH = FittedPress(6.0, 48.0)


@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)])
def test_the_mark_is_the_one_of_the_closed_form(depth_mm: float, tilt_deg: float) -> None:
    mark = mark_of(BRUSH, Condition(depth_mm, tilt_deg))
    model = stroke_model("ccd-bsm", BRUSH)
    exact = simulated(model, depth_mm, tilt_deg)[KEYS.index((Alignment.MM, Tone.BINARY))] > 0
    assert mark is not None
    assert exact.sum() > 100
    assert np.logical_xor(mark, exact).sum() <= 0.01 * exact.sum()
    assert mark_of(BRUSH, Condition(depth_mm, 85.0)) is None, "beyond the domain"


def test_likeness_is_a_cosine_and_needs_ink_on_both() -> None:
    press = Press(stroke_id="H11-a0-r00", condition=Condition(11.0, 0.0))
    mark = mark_of(BRUSH, press.condition)
    seen = LastCapture(press, 1, True, None, None, mark, mark)
    assert seen.likeness == pytest.approx(1.0)
    assert replace(seen, binary=np.roll(mark, 60, axis=0)).likeness == pytest.approx(0.0)
    for nothing in (None, np.zeros_like(mark)):
        assert replace(seen, binary=nothing).likeness is None
