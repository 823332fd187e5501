"""Where the robot's points lie on the paper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.board.register import Registration, read_points
from brushloop.calibrate.board.register import register as fit
from brushloop.calibrate.errors import CalibrationError

ROBOT = np.array([[460.0, -110.0], [460.0, 100.0], [310.0, 100.0], [310.0, -110.0], [380.0, 0.0], [420.0, 50.0]])
NAMES = [f"touch {k}" for k in range(6)]


def seen(turn_deg: float = -90.0, scale: float = 1.0, noise_mm: float = 0.05) -> np.ndarray:
    turn = np.radians(turn_deg)
    matrix = scale * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return ROBOT @ matrix.T + [110.0, 460.0] + np.random.default_rng(2).normal(0, noise_mm, ROBOT.shape)


def register(names: list[str], robot_mm: np.ndarray, seen_mm: np.ndarray) -> Registration:
    return fit(names, robot_mm, seen_mm, "points.csv", (-34.0, -34.0))


def test_turn_and_place_are_found_and_every_point_shows_its_residual() -> None:
    found = register(NAMES, ROBOT, seen())
    assert found.yaw_deg == pytest.approx(90.0, abs=0.05)
    assert found.rms_mm < 0.1
    assert found.rms_mm < found.left_out_rms_mm < 0.2
    on_paper = np.column_stack([ROBOT, np.ones(6)]) @ found.matrix.T
    assert on_paper == pytest.approx(seen(), abs=0.3)
    assert np.append(found.origin_mm, 1.0) @ found.matrix.T == pytest.approx([0.0, 0.0])


def test_a_point_that_slipped_is_dropped_by_name_and_does_not_pull() -> None:
    marks = seen()
    marks[3] += (4.0, -2.0)
    found = register(NAMES, ROBOT, marks)
    assert list(found.dropped) == ["touch 3"]
    assert found.dropped["touch 3"] == pytest.approx([4.0, -2.0], abs=0.3)
    assert found.yaw_deg == pytest.approx(90.0, abs=0.05)


def test_a_board_printed_too_small_shows_in_the_residuals() -> None:
    assert register(NAMES, ROBOT, seen()).rms_mm < 0.1
    assert register(NAMES, ROBOT, seen(scale=0.99)).rms_mm > 0.5


def test_too_little_to_go_by_is_refused() -> None:
    with pytest.raises(CalibrationError, match="within 1 mm"):
        register(NAMES, ROBOT * 0.001, seen())
    with pytest.raises(CalibrationError, match="mixed up"):
        register(NAMES, ROBOT, np.random.default_rng(0).uniform(0, 200, ROBOT.shape))


def test_the_table_of_points_is_read_and_its_faults_are_named(tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text("name,robot_x_mm,robot_y_mm,image_x_px,image_y_px\na,1,2,3,4\nb,5,6,7,8\nc,9,1,2,4\n")
    points = read_points(table)
    assert points.names == ("a", "b", "c")
    assert points.image_px[1] == pytest.approx([7.0, 8.0])
    table.write_text("name,robot_x_mm,robot_y_mm,image_x_px,image_y_px\na,1,nan,3,4\n")
    with pytest.raises(CalibrationError, match="line 2, column `robot_y_mm`: 'nan' is not a finite number"):
        read_points(table)
