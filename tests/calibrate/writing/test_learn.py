"""A plan learns from ink that lies off and comes out thin: the command moves the other way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibrate.calibration import Calibration
from calibrate.compare.field import Tone
from calibrate.errors import CalibrationError
from calibrate.writing.compare import WritingComparison, as_ink
from calibrate.writing.learn import MOST_MM, learned, model_of, reach_of, smoothed
from calibrate.writing.plan_files import PlanRecord, arrays, figure_record
from calibrate.writing.scores import Character
from model.characters.ink import written as ink_of
from sessions.recording.schemas import Header, Source
from tests.calibrate.given import BY

SIDE_MM = 48.0
STROKE = np.column_stack(
    (np.linspace(12.0, 36.0, 13), np.full(13, 24.0), np.full(13, 5.0), np.full(13, 5.0), np.zeros(13))
)
"""24 mm to the right, 5 mm deep."""


def came_out(command: np.ndarray) -> np.ndarray:
    """A brush that writes 0.8 mm too high and 1 mm too thin a depth."""
    off = command.copy()
    off[:, 1] += 0.8
    off[:, 2] -= 1.0
    return ink_of(model_of(BY), [off], SIDE_MM)


def session(plan: PlanRecord, name: str = "bar") -> WritingComparison:
    [command] = arrays(plan.figures[0].commanded)
    image = plan.figures[0].wanted()
    one = Character(name, "test", as_ink(image), as_ink(image), {f"{name}-r01": as_ink(came_out(command))})
    header = Header(session_id="s", source=Source.LOOPBACK, software="test")
    calibration = Calibration.model_construct()
    return WritingComparison(header, Path("s.mcap"), "", calibration, plan, [one], [], [])


@pytest.fixture
def plan() -> PlanRecord:
    wanted = ink_of(model_of(BY), [STROKE], SIDE_MM)
    figure = figure_record("bar", "test", [STROKE], [STROKE], wanted=wanted, simulated=wanted)
    return PlanRecord(model="CCD-BSM", planned_by=BY, cell_mm=SIDE_MM, software="test", figures=(figure,))


def test_two_rounds_bring_the_ink_to_where_it_was_wanted(plan: PlanRecord) -> None:
    def miss(one: PlanRecord) -> float:
        [command] = arrays(one.figures[0].commanded)
        return float(np.abs(came_out(command) - one.figures[0].wanted()).mean())

    before = miss(plan)
    first, [lesson] = learned(session(plan))
    second, _ = learned(session(first))
    assert lesson.name == "bar"
    assert lesson.sideways_mm == pytest.approx(0.8, abs=0.35)
    assert lesson.depth_mm == pytest.approx(1.0, abs=0.4)
    assert miss(first) < 0.5 * before
    assert miss(second) < 0.3 * before
    [command] = arrays(second.figures[0].commanded)
    middle = command[len(command) // 2]
    assert middle[1] == pytest.approx(24.0 - 0.8, abs=0.25)
    assert middle[2] == pytest.approx(6.0, abs=0.4)
    # What was intended stays, point beside point.
    [intended] = arrays(second.figures[0].intended)
    assert intended.shape == command.shape
    assert np.all(intended[:, 1] == 24.0)
    assert np.array_equal(command[:, 3:], intended[:, 3:])


def test_a_correction_is_bounded_and_stays_within_reach(plan: PlanRecord) -> None:
    far = session(plan)
    blob = np.zeros((128, 128), np.float32)
    blob[0:20, 0:20] = 1.0
    far.characters[0].captured["bar-r01"] = dict.fromkeys(Tone, blob)
    made, _ = learned(far, gain=1.5)
    [command], reach = arrays(made.figures[0].commanded), reach_of(BY)
    assert np.all(np.abs(command[:, 1] - 24.0) <= MOST_MM + 1e-3)
    assert command[:, 2].min() >= reach.height_mm[0]
    assert np.all(np.linalg.norm(np.diff(command[:, :3], axis=0), axis=1) >= 1.0)


def test_a_character_that_was_not_captured_teaches_nothing(plan: PlanRecord) -> None:
    with pytest.raises(CalibrationError, match="shows no 'bar'"):
        learned(session(plan, "other"))


def test_smoothing_keeps_what_all_points_share_and_takes_out_what_one_has_alone() -> None:
    moves = np.full((9, 3), 0.5)
    np.testing.assert_allclose(smoothed(moves), moves)
    moves[4] += 1.0
    assert smoothed(moves)[4, 0] == pytest.approx(0.5 + 6 / 16)
