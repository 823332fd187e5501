"""The lag, the place and what both miss are found again in ink that a known brush has drawn."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from brushloop.calibrate.drags import MM_PER_PX, Drag, Drags, commanded_path
from brushloop.calibrate.drags import fit as drags
from brushloop.calibrate.drags.fit import LAG, PREDICTED, Kept, different, fit_values, model_of, predicted
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stats import fit_line
from brushloop.calibrate.stroke import Measured
from brushloop.model.drag import DragModel, Drawings, ink, lagging
from brushloop.sessions.records import Header, Source, Stroke

X_MM, Y_MM = np.arange(-10.0, 50.0, MM_PER_PX), np.arange(18.0, -18.0, -MM_PER_PX)
TRUTH = DragModel(half_mm=1.5, half_per_mm=0.4, leash_mm=3.0, leash_per_mm=0.5, drift_y_mm=0.5, settle_mm=2.0)


def arcs(count: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 15)
    out = []
    for _ in range(count):
        length, bend, depth = rng.uniform(20.0, 35.0), rng.uniform(-9.0, 9.0), rng.uniform(3.0, 9.0)
        out.append(np.column_stack([length * t, 4.0 * bend * t * (1.0 - t), np.full(15, depth)]))
    return out


def drawings(paths: list[np.ndarray], model: DragModel = TRUTH) -> Drawings:
    """What that brush draws, as chances of ink."""
    away = lagging(paths, model.vector()).distances(X_MM, Y_MM)
    return Drawings(paths, np.arange(len(paths) + 1), ink(away, drags.SPREAD_MM).astype(np.float32), X_MM, Y_MM)


def repeated(conditions: int, repeats: int, mm_up: list[int] | None = None, flawed: tuple[int, ...] = ()) -> Drags:
    """An imported session in which each command was drawn several times; each image is moved up by some mm."""
    length, bend = np.linspace(20.0, 35.0, conditions), np.linspace(-9.0, 9.0, conditions)
    commands = [(a, b, 5.0, 5.0, 0.0) for a, b in zip(length, bend, strict=True) for _ in range(repeats)]
    images = drawings([commanded_path(*command[:4]) for command in commands]).ink > 0.5
    strokes = []
    for k, (command, image, by) in enumerate(zip(commands, images, mm_up or [0] * len(commands), strict=True)):
        stroke, flags = Stroke(stroke_id=str(k), kind="drag", still=k), ("torn",) if k in flawed else ()
        ink = np.roll(image, round(by / MM_PER_PX), axis=0).astype(np.float32)
        strokes.append(Drag(stroke, command, Measured(1.0, 1.0, 1.0, 1.0, 1.0), False, flags, np.zeros((1, 1)), ink))
    header = Header(session_id="s", source=Source.IMPORT, software="test", protocol="")
    session = OpenSession(SimpleNamespace(header=header), "", (), None, None)
    return Drags(session, strokes, [], (X_MM, Y_MM), "")


def test_lag_and_width_are_found_again() -> None:
    values = fit_values(drawings(arcs(12, 1)))
    model, half_mm = model_of(values), values["half_mm"]
    for depth in (4.0, 8.0):
        assert model.leash_mm + model.leash_per_mm * depth == pytest.approx(3.0 + 0.5 * depth, rel=0.15)
    assert np.abs(drawings(arcs(4, 2), model).ink - drawings(arcs(4, 2)).ink).mean() < 0.01
    assert half_mm.low is not None
    assert half_mm.high is not None
    assert half_mm.low < half_mm.value < half_mm.high
    assert values["settle_mm"].low is None  # the depth is constant along each path


def test_what_the_model_lacks_is_learned_from_neighbours() -> None:
    """Strokes that lie the higher the more they bend: the correction knows those between the ones that it has seen."""
    moved = repeated(9, 1, [-2, -2, -1, -1, 0, 1, 1, 2, 2])
    even, odd = np.arange(0, 9, 2), np.arange(1, 9, 2)
    rows = predicted(TRUTH, Kept.of(moved, even), moved, odd)
    corrected, alone = (np.count_nonzero(rows[name] != (moved.drawings.ink[odd] > 0.5)) for name in (PREDICTED, LAG))
    assert corrected < 0.7 * alone


def test_repeats_of_a_command_and_strokes_with_a_defect_are_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted, of = list[set[int]](), Kept.of

    def watched(session: Drags, images: np.ndarray) -> Kept:
        fitted.append(set(images.tolist()))
        return of(session, images)

    monkeypatch.setattr(Kept, "of", watched)
    artefact = drags.fit_drags(repeated(6, 2, flawed=(11,)))
    assert len(fitted) == drags.FOLDS + 1
    assert "11" not in artefact.fitted_strokes
    assert all(11 not in images for images in fitted)
    assert all(k in images for images in fitted for k in range(10) if k ^ 1 in images)


def test_a_brush_is_adapted_to_strokes_that_differ_most() -> None:
    commands = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 6 + [[40.0, -5.0, 4.0, 4.0, 0.0], [20.0, -5.0, 4.0, 4.0, 0.0]])
    assert sorted(different(commands, 3)) == [0, 6, 7]


def test_the_commanded_path_is_the_curve_of_its_four_control_points() -> None:
    path = commanded_path(30.0, 12.0, 0.8 * 18.0, 0.2 * 18.0)
    assert path[0].tolist() == pytest.approx([0.0, 0.0, 0.2 * 18.0])
    assert path[-1].tolist() == pytest.approx([30.0, 0.0, 0.2 * 18.0])
    assert path[:, 1].max() == pytest.approx(0.75 * 12.0, abs=0.02)
    assert path[:, 2].max() == pytest.approx(0.8 * 18.0)


def test_the_slope_of_width_against_depth_has_its_interval() -> None:
    depths_mm, widths_mm = [1.0, 2.0, 3.0, 4.0], [3.0, 3.6, 3.9, 4.5]
    line, known = fit_line(depths_mm, widths_mm), stats.linregress(depths_mm, widths_mm)
    assert line is not None
    reach = stats.t.ppf(0.975, 2) * known.stderr
    assert (line.slope, line.intercept, *line.interval) == pytest.approx(
        (known.slope, known.intercept, known.slope - reach, known.slope + reach)
    )
    assert fit_line([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]) is None
