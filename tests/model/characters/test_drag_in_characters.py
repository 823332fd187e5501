"""Bristle lag in characters: the same trail as the fitted model's, differentiable, and made up for by refinement."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from brushloop.model.ccdbsm import Brush
from brushloop.model.characters.brush import Reach, dragged_depth_of
from brushloop.model.characters.drag import dragged, trail
from brushloop.model.characters.ink import swept, written
from brushloop.model.characters.plan import Cell, Path, grid, trajectory, without_tilt
from brushloop.model.characters.refine import refine
from brushloop.model.drag import DragModel, distances, trails
from brushloop.model.strokes import stroke_model

MODEL = stroke_model("ccd-bsm", Brush())
SIDE_MM, SIZE = 60.0, 96
LAG = DragModel(
    half_mm=0.8,
    half_per_mm=0.35,
    leash_mm=3.0,
    leash_per_mm=0.3,
    settle_mm=2.0,
    drift_x_mm=0.4,
    drift_y_mm=-0.3,
    drift_y_per_mm=0.05,
    land_mm=-0.5,
    back_mm=0.7,
)


def away(model: DragModel, path: np.ndarray, x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the edge of one path's mark."""
    return distances(*trails([path], model.vector()), x_mm, y_mm)[0]


def corner() -> NDArray[np.float64]:
    """(N, 5): right, then down, the heading turning with the way."""
    leg = np.linspace(12.0, 42.0, 16)
    right = np.column_stack([leg, np.full(16, 45.0), np.full(16, 6.0), np.full(16, 5.0), np.zeros(16)])
    down = np.column_stack([np.full(12, 42.0), np.linspace(43.0, 15.0, 12), np.full(12, 4.0), np.full(12, 5.0)])
    return np.concatenate([right, np.column_stack([down, np.full(12, -90.0)])])


def test_it_is_the_trail_of_the_fitted_model() -> None:
    points = corner()
    wanted = trails([without_tilt(points)], LAG.vector())[0]
    assert trail(LAG, torch.from_numpy(points)).numpy() == pytest.approx(wanted, abs=1e-9)


def test_its_image_is_that_of_the_fitted_model() -> None:
    points = corner()
    distance = away(LAG, without_tilt(points), *grid(SIDE_MM, SIZE))
    seen = dragged(LAG, torch.from_numpy(points), SIDE_MM, SIZE).numpy()
    assert seen == pytest.approx(np.clip(0.5 + distance * SIZE / SIDE_MM, 0.0, 1.0), abs=1e-6)


def test_it_is_differentiable_in_place_depth_and_heading() -> None:
    points = torch.from_numpy(corner()).requires_grad_()
    weights = torch.linspace(0.2, 1.0, 3 * (len(points) + 2), dtype=torch.float64).reshape(-1, 3)

    def total(p: torch.Tensor) -> torch.Tensor:
        return (trail(LAG, p) * weights).sum()

    assert torch.autograd.gradcheck(total, (points,))
    image = dragged(LAG, points, SIDE_MM, SIZE)
    (slope,) = torch.autograd.grad((image * torch.linspace(0, 1, SIZE, dtype=torch.float64)).sum(), points)
    assert torch.isfinite(slope).all()
    assert (slope[:, [0, 1, 2, 4]].abs().amax(dim=0) > 1e-3).all()
    assert (slope[:, 3] == 0).all(), "the tilt has no part in a drag"


def test_points_that_coincide_give_no_nan() -> None:
    points = torch.from_numpy(np.repeat(corner()[:3], 2, axis=0)).requires_grad_()
    (slope,) = torch.autograd.grad(dragged(LAG, points, SIDE_MM, SIZE).sum(), points)
    assert torch.isfinite(slope).all()


def test_a_stroke_that_does_not_travel_is_a_press() -> None:
    press = np.array([[30.0, 30.0, 8.0, 0.0, 0.0], [30.0, 30.0, 8.0, 0.0, 0.0]])
    assert np.array_equal(written(MODEL, [press], SIDE_MM, drag=LAG), written(MODEL, [press], SIDE_MM))
    assert not np.array_equal(written(MODEL, [corner()], SIDE_MM, drag=LAG), written(MODEL, [corner()], SIDE_MM))


def test_a_first_plan_is_as_deep_as_a_dragged_mark_of_that_width_needs() -> None:
    half = np.array([0.9, 2.9, 4.3, 50.0])
    depth = dragged_depth_of(LAG, Reach(), half)
    assert depth[1:3] == pytest.approx([6.0, 10.0], abs=0.01)
    assert depth.tolist()[::3] == [0.5, 20.0]


def test_refinement_makes_up_for_the_lag() -> None:
    """The plan of a corner, seen with lag, misses it; refined through the lag it leads the brush ahead."""
    cell = Cell(SIDE_MM, 3.0)
    way = Path(corner()[:, :2], np.full(28, 2.2))
    wanted = swept([way], SIDE_MM)
    reach = Reach()
    first = trajectory(way, MODEL, reach, cell, 5.0)
    made = refine(MODEL, [first], wanted, SIDE_MM, reach, 40, drag=LAG)
    assert min(made.losses) < 0.35 * made.losses[0]
    tip = made.strokes[0][:, 0].max()
    assert tip > first[:, 0].max() + 0.5, "the command goes beyond the corner"
