"""The lag, the place and what both miss are found again in ink that a known brush has drawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench import accuracy
from bench.brushes import DATA
from brushloop.calibrate.drags import fit as drags
from brushloop.calibrate.drags.captures import Drawn, commanded_path
from brushloop.calibrate.drags.fit import LAG, PREDICTED, Kept, different, fit_drags, predicted
from brushloop.model.drag import DragModel, Drawings, ink, lagging
from brushloop.sessions.records import Header, Source

X_MM, Y_MM = np.arange(-10.0, 50.0, 1.0), np.arange(18.0, -18.0, -1.0)
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


def repeated(conditions: int, repeats: int, rows_up: list[int] | None = None) -> Drawn:
    """An imported session in which each command was drawn several times; each image is moved up by a number of rows."""
    length, bend, depth = np.linspace(20.0, 35.0, conditions), np.linspace(-9.0, 9.0, conditions), 5.0
    rows = [[a, b, depth, depth, 0.0] for a, b in zip(length, bend, strict=True) for _ in range(repeats)]
    drawn = drawings([commanded_path(*row[:4]) for row in rows])
    seen = (drawn.ink > 0.5).astype(np.float32)
    seen = np.array([np.roll(image, by, axis=0) for image, by in zip(seen, rows_up or [0] * len(rows), strict=True)])
    header = Header(session_id="s", source=Source.IMPORT, software="test", protocol="")
    names = [str(k) for k in range(len(rows))]
    return Drawn(header, "", names, np.array(rows), replace(drawn, ink=seen), np.arange(len(rows)))


def test_lag_and_width_are_found_again() -> None:
    fit = fit_drags(drawings(arcs(12, 1)))
    for depth in (4.0, 8.0):
        assert fit.model.leash_mm + fit.model.leash_per_mm * depth == pytest.approx(3.0 + 0.5 * depth, rel=0.15)
    assert np.abs(drawings(arcs(4, 2), fit.model).ink - drawings(arcs(4, 2)).ink).mean() < 0.01
    values = fit.values()
    low, high = values["half_mm"].low, values["half_mm"].high
    assert low is not None
    assert high is not None
    assert low < fit.model.half_mm < high
    assert values["settle_mm"].low is None  # the depth is constant along each path


def test_only_what_is_free_moves() -> None:
    elsewhere = drawings(arcs(3, 5), replace(TRUTH, drift_x_mm=0.8, drift_y_mm=-0.6))
    fit = fit_drags(elsewhere, TRUTH, {"drift_x_mm": 1.0, "drift_y_mm": 1.0})
    assert (fit.model.drift_x_mm, fit.model.drift_y_mm) == pytest.approx((0.8, -0.6), abs=0.1)
    assert replace(fit.model, drift_x_mm=0.0, drift_y_mm=0.5) == TRUTH


def test_what_the_model_lacks_is_learned_from_neighbours() -> None:
    """Strokes that lie the higher the more they bend: the correction knows those between the ones that it has seen."""
    drawn = repeated(9, 1, [-2, -2, -1, -1, 0, 1, 1, 2, 2])
    even, odd = np.arange(0, 9, 2), np.arange(1, 9, 2)
    rows = predicted(TRUTH, Kept.of(drawn, even), drawn, odd)
    corrected, alone = (np.count_nonzero(rows[name] != (drawn.drawings.ink[odd] > 0.5)) for name in (PREDICTED, LAG))
    assert corrected < 0.7 * alone


def test_repeats_of_a_command_and_strokes_with_a_defect_are_not_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, fitted = replace(repeated(6, 2), sound=np.arange(11)), list[set[int]]()
    of = Kept.of

    def watched(one: Drawn, images: np.ndarray) -> Kept:
        fitted.append(set(images.tolist()))
        return of(one, images)

    monkeypatch.setattr(Kept, "of", watched)
    artefact = drags.fit_drawn(drawn)
    assert len(fitted) == drags.FOLDS + 1
    assert "11" not in artefact.fitted_strokes
    assert all(11 not in images for images in fitted)
    assert all(k in images for images in fitted for k in range(10) if k ^ 1 in images)


def test_a_brush_is_adapted_to_strokes_that_differ_most() -> None:
    commands = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 6 + [[40.0, -5.0, 4.0, 4.0, 0.0], [20.0, -5.0, 4.0, 4.0, 0.0]])
    assert sorted(different(commands, 3)) == [0, 6, 7]
    assert drags.session_change(commands)["leash_per_mm"] == pytest.approx(0.5)


def test_the_commanded_path_is_the_curve_of_its_four_control_points() -> None:
    path = commanded_path(30.0, 12.0, 0.8 * 18.0, 0.2 * 18.0)
    assert path[0].tolist() == pytest.approx([0.0, 0.0, 0.2 * 18.0])
    assert path[-1].tolist() == pytest.approx([30.0, 0.0, 0.2 * 18.0])
    assert path[:, 1].max() == pytest.approx(0.75 * 12.0, abs=0.02)
    assert path[:, 2].max() == pytest.approx(0.8 * 18.0)


@pytest.mark.skipif(not (DATA / accuracy.BIG).is_dir(), reason="the folder of real strokes is not here")
@pytest.mark.soak
@pytest.mark.timeout(3000)
def test_real_strokes_that_were_never_fitted_are_predicted() -> None:
    means = accuracy.drags_within(20, draw=0, seed=5)
    assert means[PREDICTED]["csim"] > means[LAG]["csim"] > 0.82
    assert means[PREDICTED]["iou"] > 0.70
