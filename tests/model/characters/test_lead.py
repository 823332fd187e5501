"""A plan that knows the footprint leads the brush: the tip runs ahead, the ink lands where it is wanted."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.model.characters.glyph import swept
from brushloop.model.characters.plan import (
    Phase,
    Reach,
    StrokePath,
    covered,
    drawn,
    first_lead,
    grid,
    lead,
    phases_of,
    resampled,
)
from brushloop.model.drag import NAMES, START, Drawings, Footprint, fit_each, fit_footprint, inked, marks, sampled

SIDE_MM, SIZE_PX = 48.0, 96
HOOK = np.array([[12.0, 36.0], [20.0, 36.0], [28.0, 36.0], [34.0, 34.0], [34.0, 26.0], [33.0, 18.0], [30.0, 21.0]])


def hook() -> StrokePath:
    points = resampled(HOOK, 2.0)
    half = np.full(len(points), 2.0)
    half[-2:] = 1.0, 0.3
    return StrokePath(points, half)


def test_leading_the_brush_puts_the_ink_on_the_corner() -> None:
    path, brush, reach = hook(), Footprint(), Reach()
    wanted = swept([path], SIDE_MM, SIZE_PX)

    def wrong(strokes: list[np.ndarray]) -> int:
        seen = covered(drawn([brush] * len(strokes), strokes, SIDE_MM, SIZE_PX), SIDE_MM)
        return np.count_nonzero((seen > 0.5) != (wanted > 0.5))

    first = first_lead([path], brush, reach, SIDE_MM, 5.0)
    led = lead([brush], first, wanted, SIDE_MM, reach)
    assert wrong(led) < 0.5 * wrong(first)
    assert led[0][:, 0].max() > HOOK[:, 0].max() + 0.5  # the tip goes on beyond the corner
    assert np.all(np.linalg.norm(np.diff(led[0][:, :3], axis=0), axis=1) >= reach.apart_mm)
    assert led[0][:, 2].max() <= reach.depth_mm[1]


def test_a_footprint_is_found_again_from_its_ink() -> None:
    true = Footprint(
        tuple({**dict(zip(NAMES, Footprint().values, strict=True)), "leash_mm": 2.0, "half_mm_2": 0.9}.values())
    )
    x_mm, y_mm = grid(SIDE_MM, 64)
    paths = [
        np.array([[14.0, 24.0, depth, turn], [34.0, 24.0, depth, turn], [30.0, 14.0, 0.5 * depth, turn]])
        for depth, turn in ((3.0, 0.0), (6.0, 30.0), (9.0, -20.0))
    ]
    ink = np.array([inked([true], [path], x_mm, y_mm) > 0.0 for path in paths], np.float32)
    found = fit_footprint(Drawings(paths, np.arange(4), ink, x_mm, y_mm))

    def wrong(brush: Footprint) -> int:
        seen = [inked([brush], [path], x_mm, y_mm) > 0.0 for path in paths]
        return np.count_nonzero(np.array(seen) != (ink > 0.5))

    assert wrong(found) < 0.4 * wrong(Footprint())
    with pytest.raises(ValueError, match="a footprint has 28 finite values, got 2"):
        Footprint((1.0, 2.0))


def test_pressing_deeper_on_the_spot_marks_like_landing_as_deep() -> None:
    lands = np.array([[24.0, 24.0, 8.0, 30.0], [24.01, 24.0, 8.0, 30.0]])
    deepens = np.array([[24.0, 24.0, 2.0, 30.0], [24.01, 24.0, 8.0, 30.0]])
    ink, slid = (inked([Footprint()], [path], *grid(SIDE_MM, 64)) for path in (lands, deepens))
    deep = ink > 0.3
    assert deep.sum() > 30
    assert np.all(slid[deep] > 0.0)
    nodes = sampled(lands)
    middle_disc = marks([nodes], np.array(START)).discs[1::3]
    behind = np.hypot(*(middle_disc[:, :2] - (24.0, 24.0)).T)
    assert behind[nodes[:, 2] == 8.0][0] == pytest.approx(4.5, abs=0.1)  # it slid there while the brush went down


def test_each_stroke_has_a_footprint_of_its_own() -> None:
    wide, narrow = (
        Footprint(tuple({**dict(zip(NAMES, Footprint().values, strict=True)), "half_mm_2": half}.values()))
        for half in (1.2, 0.4)
    )
    x_mm, y_mm = grid(SIDE_MM, 64)
    paths = [np.array([[12.0, y, 5.0, 0.0], [36.0, y, 5.0, 0.0]]) for y in (16.0, 32.0)]
    ink = (inked([wide, narrow], paths, x_mm, y_mm) > 0.0).astype(np.float32)[None]
    upper, lower = fit_each(Drawings(paths, np.array([0, 2]), ink, x_mm, y_mm), Footprint())
    depth = np.array([5.0])
    assert upper.half_width_mm(depth) > lower.half_width_mm(depth) + 0.4
    assert np.count_nonzero((inked([upper, lower], paths, x_mm, y_mm) > 0.0) != (ink[0] > 0.5)) < 40


def test_a_path_is_sampled_densely_from_its_landing_to_its_lift() -> None:
    path = np.array([[0.0, 0.0, 1.0, 0.0], [3.0, 0.0, 1.0, 0.0], [3.0, 4.0, 2.0, 90.0]])
    dense = sampled(path)
    assert np.linalg.norm(np.diff(dense[:, :3], axis=0), axis=1).max() <= 0.5
    assert all((dense == corner).all(axis=1).any() for corner in path)
    assert dense[0].tolist() == [0.0, 0.0, 0.0, 0.0]
    assert dense[-1].tolist() == [3.0, 4.0, 0.0, 90.0]


def test_a_brush_that_lifts_marks_ahead_of_where_it_was_dragged_to() -> None:
    path = np.array([[14.0, 24.0, 8.0, 0.0], [34.0, 24.0, 8.0, 0.0]])
    dragged, lifted = (marks([nodes], np.array(START)).discs for nodes in (path, sampled(path)))
    assert dragged[-2, 0] == pytest.approx(34.0 - float(Footprint().lag_mm(np.array([8.0]))[0]))
    assert lifted[-2, 0] == pytest.approx(34.0 - float(Footprint().lag_mm(np.array([0.0]))[0]))


def test_a_stroke_is_divided_into_phases() -> None:
    phases = phases_of(hook())
    assert phases[0] is Phase.INITIATION_HIDDEN
    assert phases[-1] is Phase.TERMINATION_EXPOSED
    corner = int(np.argmin(np.linalg.norm(hook().points - (34.0, 34.0), axis=1)))
    assert phases[corner] is Phase.TURNING
    assert Phase.EXECUTION in phases
    back = StrokePath(np.array([[x, 0.0] for x in range(10)] + [[8.0 - x, 1.0] for x in range(8)]), np.full(18, 1.0))
    assert Phase.FOLDING in phases_of(back)
