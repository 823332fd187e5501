"""The lag, the place and what both miss are found again in ink that a known brush has drawn."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.artefact import put_to_use
from brushloop.calibrate.drags import brush as brushes
from brushloop.calibrate.drags import report
from brushloop.calibrate.drags.brush import BETWEEN_SESSIONS, Learned, different, learn
from brushloop.calibrate.drags.captures import Drawn, commanded_path
from brushloop.calibrate.drags.fit import (
    SPREAD_MM,
    Correction,
    fit_drags,
    marks_mm,
    threshold,
)
from brushloop.model.drag import DragModel, Drawings, ink
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


def drawings(paths: list[np.ndarray], model: DragModel = TRUTH, groups: np.ndarray | None = None) -> Drawings:
    """What that brush draws, as chances of ink."""
    each = np.arange(len(paths) + 1) if groups is None else groups
    count = len(each) - 1
    blank = Drawings(paths, each, np.zeros((count, len(Y_MM), len(X_MM)), np.float32), X_MM, Y_MM, np.ones(count))
    return replace(blank, ink=ink(marks_mm(model, blank), SPREAD_MM).astype(np.float32))


def session(commands: np.ndarray, model: DragModel = TRUTH) -> Drawn:
    """An imported session of these commands, with the ink that `model` draws."""
    drawn = drawings([commanded_path(*row[:4]) for row in commands], model)
    names = [str(k) for k in range(len(commands))]
    header = Header(session_id="s", source=Source.IMPORT, software="test", protocol="")
    seen = replace(drawn, ink=(drawn.ink > 0.5).astype(np.float32))
    return Drawn(header, "", None, seen, names, [], commands, [()] * len(names), "depth_ends_mm")


def repeated(conditions: int, repeats: int) -> Drawn:
    """A session in which each command was drawn several times."""
    length, bend, depth = np.linspace(20.0, 35.0, conditions), np.linspace(-9.0, 9.0, conditions), 5.0
    commands = [[a, b, depth, depth, 0.0] for a, b in zip(length, bend, strict=True) for _ in range(repeats)]
    return session(np.array(commands))


def moved(drawn: Drawn, rows: list[int]) -> Drawn:
    """The same with each image moved up by a number of rows."""
    images = np.array([np.roll(image, by, axis=0) for image, by in zip(drawn.drawings.ink, rows, strict=True)])
    return replace(drawn, drawings=replace(drawn.drawings, ink=images))


def test_lag_and_width_are_found_again() -> None:
    fit = fit_drags(drawings(arcs(12, 1)))
    for depth in (4.0, 8.0):
        assert fit.model.leash_mm + fit.model.leash_per_mm * depth == pytest.approx(3.0 + 0.5 * depth, rel=0.15)
    others = drawings(arcs(4, 2))
    assert np.abs(drawings(arcs(4, 2), fit.model).ink - others.ink).mean() < 0.01
    values = fit.values()
    low, high = values["half_mm"].low, values["half_mm"].high
    assert low is not None
    assert high is not None
    assert low < fit.model.half_mm < high
    assert values["settle_mm"].low is None  # the depth is constant along each path


def test_figures_of_several_strokes_are_fitted_as_a_whole() -> None:
    """Crosses: one stroke to the right, one down, the brush turned with it."""
    rng, paths = np.random.default_rng(4), list[np.ndarray]()
    t = np.linspace(0.0, 1.0, 12)[:, None]
    for _ in range(8):
        for start, way, heading in (((0.0, 0.0), (1.0, 0.0), 0.0), ((12.0, 14.0), (0.0, -1.0), -90.0)):
            xy = np.array(start) + t * rng.uniform(22.0, 30.0) * np.array(way)
            paths.append(np.column_stack([xy, np.full(12, rng.uniform(3.0, 8.0)), np.full(12, heading)]))
    fit = fit_drags(drawings(paths, groups=np.arange(0, 17, 2)))
    for depth in (3.0, 8.0):
        assert fit.model.leash_mm + depth * fit.model.leash_per_mm == pytest.approx(3.0 + 0.5 * depth, rel=0.2)
    with pytest.raises(ValueError, match="not alike"):
        replace(drawings(paths), groups=np.arange(0, 17, 2))


def test_only_what_is_free_moves_and_a_known_miss_is_no_change_of_place() -> None:
    paths = arcs(3, 5)
    drift = {"drift_x_mm": 1.0, "drift_y_mm": 1.0}
    elsewhere = replace(TRUTH, drift_x_mm=0.8, drift_y_mm=-0.6)
    fit = fit_drags(drawings(paths, elsewhere), start=TRUTH, freedom=drift)
    assert (fit.model.drift_x_mm, fit.model.drift_y_mm) == pytest.approx((0.8, -0.6), abs=0.1)
    assert replace(fit.model, drift_x_mm=0.0, drift_y_mm=0.5) == TRUTH
    true = drawings(paths)
    missed = marks_mm(TRUTH, true) - marks_mm(elsewhere, true)
    knowing = fit_drags(true, start=elsewhere, freedom=drift, added_mm=missed)
    assert knowing.model.drift_y_mm == pytest.approx(elsewhere.drift_y_mm, abs=0.1)


def test_a_stroke_that_counts_less_moves_the_fit_less() -> None:
    drawn = drawings(arcs(4, 6))
    drawn.ink[0] = drawings(arcs(4, 6), replace(TRUTH, half_mm=3.0)).ink[0]
    even, less = (
        fit_drags(replace(drawn, weights=np.array([w, 1.0, 1.0, 1.0])), start=TRUTH, freedom={"half_mm": 2.0})
        for w in (1.0, 0.1)
    )
    assert TRUTH.half_mm <= less.model.half_mm < even.model.half_mm - 0.1


def test_what_the_model_lacks_is_learned_from_neighbours() -> None:
    """Strokes that lie the higher the more they bend: the correction knows those between the ones that it has seen."""
    drawn = moved(repeated(9, 1), [-2, -2, -1, -1, 0, 1, 1, 2, 2])
    even, odd = np.arange(0, 9, 2), np.arange(1, 9, 2)
    assert drawn.commands is not None
    learned = Correction.fit(drawn.commands[even], drawn.drawings.only(even), TRUTH)
    others = drawn.drawings.only(odd)
    added = learned.added_mm(drawn.commands[odd], others.x_mm, others.y_mm)
    alone, corrected = (marks_mm(TRUTH, others) + by for by in (0.0, added))
    wrong = [np.count_nonzero((away > 0.0) != (others.ink > 0.5)) for away in (alone, corrected)]
    assert wrong[1] < 0.6 * wrong[0]


def test_the_threshold_is_judged_on_commands_that_were_left_out() -> None:
    """Strokes of a command are alike, and lie where no other command tells: only repeats predict them."""
    rng = np.random.default_rng(0)
    commands = np.repeat(np.column_stack([rng.uniform(0.0, 1.0, (12, 4)), np.zeros(12)]), 6, axis=0)
    x = np.linspace(-6.0, 6.0, 33)
    by_mm = np.repeat(rng.choice([-3.0, 3.0], 12), 6)
    base = np.broadcast_to(2.0 - np.abs(x), (72, 33, 33)).copy()
    captured = np.array([np.broadcast_to(2.0 - np.abs(x - by), (33, 33)) for by in by_mm])
    assert threshold(commands, base, captured) == threshold(commands[::6], base[::6], captured[::6])


def test_repeats_of_a_command_are_left_out_together(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn, fitted = repeated(6, 2), list[set[int]]()

    def watched(one: Drawn, images: np.ndarray) -> Learned:
        fitted.append(set(images.tolist()))
        return learn(one, images)

    monkeypatch.setattr(brushes, "learn", watched)
    held_out = brushes.fit_drawn(drawn).held_out
    assert len(fitted) == 1 + brushes.FOLDS
    assert all(k in images for images in fitted for k in range(12) if k ^ 1 in images)
    assert all(score.images == 12 for score in held_out.values())


def test_a_correction_is_used_in_part_in_another_session() -> None:
    drawn = moved(repeated(6, 1), [0, 0, 0, 2, 2, 2])
    fitted = brushes.fit_drawn(drawn)
    digests = (fitted.recording_sha256, "the digest of another recording")
    own, other = (fitted.predictor("fit.json", digest).added_mm(drawn, np.arange(6)) for digest in digests)
    assert own is not None
    assert np.abs(own).max() > 0.2
    np.testing.assert_allclose(other, BETWEEN_SESSIONS * own)


def test_a_correction_that_made_the_strokes_seen_worse_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One session teaches that strokes lie apart as they bend; the next one does not have that, another one does."""
    plain = repeated(8, 1)
    taught = moved(plain, [3, 3, 3, 3, -3, -3, -3, -3])
    prior = brushes.fit_drawn(replace(taught, recording_sha256="taught"))
    for shown, helps in ((plain, False), (taught, True)):
        another = replace(shown, recording_sha256="another")
        path = put_to_use(brushes.refit_drawn(another, prior, "fit.json", 4), tmp_path, brushes.FOLDER)
        monkeypatch.setattr(report, "read_drags", lambda *_, another=another: another)
        found = report.predict_session(tmp_path, path)
        assert found.corrected is helps
        assert found.fitted.sum() == 4
        if not helps:
            assert found.means()[report.OURS] == found.means()[report.LAG]


def test_a_brush_is_adapted_to_strokes_that_differ_most() -> None:
    commands = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 6 + [[40.0, -5.0, 4.0, 4.0, 0.0], [20.0, -5.0, 4.0, 4.0, 0.0]])
    drawn = session(commands)
    assert sorted(different(drawn, np.arange(8), 3)) == [0, 6, 7]
    assert different(replace(drawn, commands=None), np.arange(8), 3).tolist() == [0, 1, 2]
    assert brushes.session_change(learn(drawn, np.arange(8)).predictor)["leash_per_mm"] == pytest.approx(0.5)
