"""A brush drawn along the paper: the lag has closed forms on a straight line and on a corner."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.model.drag import DragModel, lagging

STIFF = DragModel(half_mm=2.0, half_per_mm=0.0, leash_mm=0.0, leash_per_mm=0.0, settle_mm=0.0, front=0.0)
X_MM, Y_MM = np.linspace(-10.0, 50.0, 121), np.linspace(-20.0, 20.0, 81)


def away(model: DragModel, path: np.ndarray, x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the edge of one path's mark."""
    return lagging([path], model.vector()).distances(x_mm, y_mm)[0]


def line(length_mm: float, depth_mm: float = 5.0, nodes: int = 21) -> np.ndarray:
    x = np.linspace(0.0, length_mm, nodes)
    return np.column_stack([x, np.zeros(nodes), np.full(nodes, depth_mm)])


def test_without_a_leash_the_mark_is_discs_along_the_path() -> None:
    seen = away(STIFF, line(30.0), X_MM, Y_MM)
    along = np.clip(X_MM, 0.0, 30.0)
    wanted = 2.0 - np.hypot(X_MM[None] - along[None], Y_MM[:, None])
    assert np.abs(seen - wanted).max() < 0.06  # a leash is never shorter than 0.05 mm


@pytest.mark.parametrize("nodes", [2, 9, 200])
def test_the_lag_is_that_of_first_order_however_the_path_is_cut(nodes: int) -> None:
    model = DragModel(leash_mm=4.0, leash_per_mm=0.0, front=0.0)
    trail = lagging([line(20.0, nodes=nodes)], model.vector()).discs
    assert trail[-2, 0] == pytest.approx(20.0 - 4.0 * (1.0 - np.exp(-20.0 / 4.0)), abs=1e-9)


def test_a_corner_is_cut_and_more_so_at_depth() -> None:
    model = DragModel(leash_mm=1.0, leash_per_mm=0.5, half_per_mm=0.0)
    leg = np.linspace(0.0, 25.0, 26)
    cut = []
    for depth in (2.0, 8.0):
        corner = np.concatenate([np.column_stack([leg, 0 * leg]), np.column_stack([0 * leg[1:] + 25.0, -leg[1:]])])
        trail = lagging([np.column_stack([corner, np.full(len(corner), depth)])], model.vector()).discs
        cut.append(np.hypot(trail[:, 0] - 25.0, trail[:, 1]).min())
    assert 0.2 < cut[0] < cut[1]


def test_lifting_below_no_width_leaves_no_ink() -> None:
    model = DragModel(half_mm=-1.0, half_per_mm=0.5, settle_mm=0.05)
    path = line(30.0)
    path[8:13, 2] = 1.0  # half width -0.5 mm in the middle
    middle = away(model, path, np.array([15.0]), Y_MM)
    assert middle.max() < 0.0
    assert away(model, path, np.array([2.0]), np.array([0.0])).item() > 0.0
