from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.artefact import put_to_use
from brushloop.calibrate.drags import predicted, run
from brushloop.calibrate.drags.captures import Drawn, commanded_path
from brushloop.calibrate.drags.fit import INK_ABOVE, SPREAD_MM, Residual, determined, fit_drags, threshold
from brushloop.calibrate.drags.predict import BETWEEN_SESSIONS, Learned, learn, predictors
from brushloop.calibrate.drags.run import different
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Waypoint
from brushloop.model.drag import DragModel, distances, ink, trails
from brushloop.sessions.records import Header, Source

X_MM, Y_MM = np.arange(-10.0, 50.0, 1.0), np.arange(-18.0, 18.0, 1.0)
TRUTH = DragModel(half_mm=1.5, half_per_mm=0.4, leash_mm=3.0, leash_per_mm=0.5, drift_y_mm=0.5, settle_mm=2.0)


def away(model: DragModel, path: np.ndarray, x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the edge of one path's mark."""
    return distances(*trails([path], model.vector()), x_mm, y_mm)[0]


def arcs(count: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, 15)
    out = []
    for _ in range(count):
        length, bend, depth = rng.uniform(20.0, 35.0), rng.uniform(-9.0, 9.0), rng.uniform(3.0, 9.0)
        out.append(np.column_stack([length * t, 4.0 * bend * t * (1.0 - t), np.full(15, depth)]))
    return out


def drawn(model: DragModel, paths: list[np.ndarray]) -> np.ndarray:
    return np.array([ink(away(model, path, X_MM, Y_MM), SPREAD_MM) for path in paths])


def test_lag_and_width_are_found_again() -> None:
    paths = arcs(12, 1)
    fit = fit_drags(paths, drawn(TRUTH, paths), X_MM, Y_MM)
    for depth in (4.0, 8.0):
        assert fit.model.leash_mm + fit.model.leash_per_mm * depth == pytest.approx(3.0 + 0.5 * depth, rel=0.15)
    others = arcs(4, 2)
    assert np.abs(drawn(fit.model, others) - drawn(TRUTH, others)).mean() < 0.01
    assert fit.condition < 1e5


def test_the_place_on_a_page_is_distinguished_from_the_brush() -> None:
    paths = arcs(12, 3)
    place = np.linspace(-1.0, 1.0, 12)[:, None]
    moved = [path + np.array([0.0, 1.5 * float(p[0]), 0.0]) for path, p in zip(paths, place, strict=True)]
    fit = fit_drags(paths, drawn(TRUTH, moved), X_MM, Y_MM, place)
    assert fit.place_mm[0] == pytest.approx([0.0, 1.5], abs=0.25)


def test_what_the_model_lacks_is_learned_from_neighbours() -> None:
    commands = np.column_stack([np.linspace(0.0, 1.0, 20), np.zeros(20)])
    base = np.zeros((20, 4, 4))
    captured = base + np.sin(3.0 * commands[:, 0])[:, None, None]
    residual = Residual.fit(commands[::2], base[::2], captured[::2], ridge=0.01)
    assert np.abs(residual.add(commands[1:-1:2], base[1:-1:2]) - captured[1:-1:2]).max() < 0.05


def test_the_threshold_is_judged_on_commands_that_were_left_out() -> None:
    """Strokes of a command are alike, and lie where no other command tells: only repeats predict them."""
    rng = np.random.default_rng(0)
    commands = np.repeat(np.column_stack([rng.uniform(0.0, 1.0, (12, 4)), np.zeros(12)]), 6, axis=0)
    x = np.linspace(-6.0, 6.0, 33)
    moved = np.repeat(rng.choice([-3.0, 3.0], 12), 6)
    base = np.broadcast_to(2.0 - np.abs(x), (72, 33, 33)).copy()
    captured = np.array([np.broadcast_to(2.0 - np.abs(x - by), (33, 33)) for by in moved])
    assert threshold(commands, base, captured) == threshold(commands[::6], base[::6], captured[::6])


def test_repeats_of_a_command_are_left_out_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six commands drawn twice each: no fit sees a command that it is scored on."""
    session = repeated(6, 2)
    scored: list[tuple[set[int], set[int]]] = []

    def watched(fitted: Drawn, images: np.ndarray) -> Learned:
        scored.append((set(images.tolist()), set(range(12)) - set(images.tolist())))
        return learn(fitted, images)

    monkeypatch.setattr(run, "learn", watched)
    found = run.fit_drawn(session).artefact.held_out
    assert {score.images for score in found.values()} == {12}
    for others, left in scored[1:]:
        assert left
        assert not {k // 2 for k in left} & {k // 2 for k in others}


def test_of_strokes_that_scatter_less_certain_pixels_count_as_ink() -> None:
    rng = np.random.default_rng(0)
    commands = np.column_stack([np.linspace(0.0, 1.0, 24), np.zeros(24)])
    x = np.linspace(-4.0, 4.0, 33)
    base = np.broadcast_to(3.0 - np.abs(x), (24, 33, 33)).copy()
    little, much = (base + rng.normal(0.0, sd, 24)[:, None, None] for sd in (0.3, 3.0))
    assert threshold(commands, base, much) < threshold(commands, base, little)
    assert threshold(commands[:4], base[:4], much[:4]) == INK_ABOVE


def test_a_parameter_that_the_strokes_do_not_determine_is_named() -> None:
    """At a constant depth the width has nothing to settle from."""
    paths = arcs(6, 1)
    fit = fit_drags(paths, drawn(TRUTH, paths), X_MM, Y_MM)
    known = dict(zip(fit.free, determined(fit), strict=True))
    assert not known["settle_mm"]
    assert known["half_mm"]
    assert known["drift_y_mm"]


def test_a_known_brush_is_adapted_by_its_place_alone() -> None:
    paths = arcs(3, 5)
    moved = replace(TRUTH, drift_x_mm=0.8, drift_y_mm=-0.6)
    only = {"drift_x_mm": 1.0, "drift_y_mm": 1.0}
    fit = fit_drags(paths, drawn(moved, paths), X_MM, Y_MM, start=TRUTH, only=only)
    assert (fit.model.drift_x_mm, fit.model.drift_y_mm) == pytest.approx((0.8, -0.6), abs=0.1)
    assert replace(fit.model, drift_x_mm=0.0, drift_y_mm=0.5) == TRUTH
    assert fit.free == ("drift_x_mm", "drift_y_mm")


def test_what_a_model_is_known_to_miss_is_not_taken_for_a_change_of_place() -> None:
    """All strokes of one kind: what the lag misses of them lies across their bend, like a change of place."""
    paths = arcs(2, 5)
    true = np.array([away(TRUTH, path, X_MM, Y_MM) for path in paths])
    wrong = replace(TRUTH, drift_y_mm=-0.7)
    missed = true - np.array([away(wrong, path, X_MM, Y_MM) for path in paths])
    only = {"drift_y_mm": 1.0}
    plain = fit_drags(paths, ink(true, SPREAD_MM), X_MM, Y_MM, start=wrong, only=only)
    knowing = fit_drags(paths, ink(true, SPREAD_MM), X_MM, Y_MM, start=wrong, only=only, added_mm=missed)
    assert plain.model.drift_y_mm == pytest.approx(TRUTH.drift_y_mm, abs=0.1)
    assert knowing.model.drift_y_mm == pytest.approx(wrong.drift_y_mm, abs=0.1)


def test_a_stroke_that_counts_less_moves_the_fit_less() -> None:
    paths = arcs(4, 6)
    images = drawn(TRUTH, paths)
    images[0] = drawn(replace(TRUTH, half_mm=3.0), paths[:1])[0]
    even, less = (
        fit_drags(paths, images, X_MM, Y_MM, start=TRUTH, only={"half_mm": 2.0}, weights=np.array([w, 1.0, 1.0, 1.0]))
        for w in (1.0, 0.1)
    )
    assert TRUTH.half_mm <= less.model.half_mm < even.model.half_mm - 0.1


def test_the_simulated_brush_trails_and_the_fit_sees_it() -> None:
    """On the loopback rig: a brush drawn along an L stays away from the corner, and circles at the tip do not."""
    brush = Brush(BrushSpec())
    paths, images = [], []
    for k, (depth, turn) in enumerate([(4.0, -1.0), (7.0, -1.0), (4.0, 1.0), (7.0, 1.0)]):
        corners = [(0.0, 0.0), (25.0, 0.0), (25.0, 14.0 * turn)]
        mark = brush.drag([Waypoint(x, y, depth) for x, y in corners], 0.0, 0.0, ink_load=1.0, press_seed=k)
        leg, rise = np.linspace(0.0, 25.0, 15), np.linspace(0.0, 14.0 * turn, 9)[1:]
        xy = np.concatenate([np.column_stack([leg, 0 * leg]), np.column_stack([0 * rise + 25.0, rise])])
        paths.append(np.column_stack([xy, np.full(len(xy), depth)]))
        column = np.round(mark.origin_px[0] + X_MM * mark.px_per_mm).astype(int)
        row = np.round(mark.origin_px[1] - Y_MM * mark.px_per_mm).astype(int)
        padded = np.pad(mark.density, 400)
        images.append(padded[np.ix_(row + 400, column + 400)] > 0.3)
    target = np.array(images)
    lagging = fit_drags(paths, target, X_MM, Y_MM)
    stamps = fit_drags(paths, target, X_MM, Y_MM, lag=False)
    assert lagging.cost < 0.8 * stamps.cost
    assert 1.0 < lagging.model.leash_mm + 7.0 * lagging.model.leash_per_mm < 15.0
    seen = ink(lagging.distance(paths, X_MM, Y_MM), SPREAD_MM) > INK_ABOVE
    assert np.count_nonzero(seen & target) / np.count_nonzero(seen | target) > 0.7


def test_what_does_not_belong_together_is_refused() -> None:
    paths = arcs(2, 1)
    with pytest.raises(ValueError, match="not alike"):
        fit_drags(paths, np.zeros((3, len(Y_MM), len(X_MM))), X_MM, Y_MM)
    with pytest.raises(ValueError, match="not alike"):
        fit_drags(paths, drawn(replace(TRUTH), paths), X_MM, Y_MM, np.zeros((3, 1)))


def test_a_correction_is_used_in_part_in_another_session() -> None:
    """Half of the strokes lie aside, which the correction learns."""
    session = repeated(6, 1)
    session.ink[3:] = np.roll(session.ink[3:], 2, axis=1)
    fitted = run.fit_drawn(session).artefact
    images = np.arange(6)
    own, _ = predictors(fitted, "fit.json", fitted.recording_sha256)
    other, _ = predictors(fitted, "fit.json", "the digest of another recording")
    learned, used = own.correction(session, images), other.correction(session, images)
    assert learned is not None
    assert used is not None
    assert np.abs(learned).max() > 0.2
    np.testing.assert_allclose(used, BETWEEN_SESSIONS * learned)


def test_a_correction_that_made_the_strokes_seen_worse_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One session teaches that strokes lie apart as they bend; the next one does not have that, another one does."""
    taught, plain = repeated(8, 1), repeated(8, 1)
    taught.ink[:4], taught.ink[4:] = np.roll(taught.ink[:4], 3, axis=1), np.roll(taught.ink[4:], -3, axis=1)
    prior = run.fit_drawn(replace(taught, recording_sha256="taught")).artefact
    for shown, helps in ((plain, False), (taught, True)):
        session = replace(shown, recording_sha256="another")
        adapted = run.refit_drawn(session, prior, "fit.json", 4).artefact
        path = put_to_use(adapted, tmp_path, run.FOLDER)
        monkeypatch.setattr(predicted, "read_drags", lambda *_, session=session: session)
        found = predicted.predict_session(tmp_path, path)
        assert found.corrected is helps
        means = found.means()
        if not helps:
            assert means[predicted.OURS] == means[predicted.LAG]


def repeated(conditions: int, repeats: int) -> Drawn:
    """A session in which each command was drawn several times."""
    length, bend, depth = np.linspace(20.0, 35.0, conditions), np.linspace(-9.0, 9.0, conditions), 5.0
    commands = np.array([[a, b, depth, depth, 0.0] for a, b in zip(length, bend, strict=True) for _ in range(repeats)])
    return drawn_session(commands)


def drawn_session(commands: np.ndarray, truth: DragModel = TRUTH) -> Drawn:
    """An imported session of these commands, with the ink that `truth` draws."""
    paths = [commanded_path(*row[:4]) for row in commands]
    count = len(commands)
    return Drawn(
        header=Header(session_id="s", source=Source.IMPORT, software="test", protocol=""),
        recording_sha256="",
        calibration=None,
        x_mm=X_MM,
        y_mm=Y_MM[::-1],
        paths=paths,
        groups=np.arange(count + 1),
        ink=np.array([away(truth, path, X_MM, Y_MM[::-1]) > 0.0 for path in paths], np.float32),
        stroke_ids=[str(k) for k in range(count)],
        refused=[],
        commands=commands,
        flags=[()] * count,
        ends="depth_ends_mm",
    )


def test_a_brush_is_adapted_to_strokes_that_differ_most() -> None:
    commands = np.array([[20.0, 5.0, 2.0, 2.0, 0.0]] * 6 + [[40.0, -5.0, 4.0, 4.0, 0.0], [20.0, -5.0, 4.0, 4.0, 0.0]])
    session = drawn_session(commands)
    assert sorted(different(session, np.arange(8), 3)) == [0, 6, 7]
    assert different(replace(session, commands=None), np.arange(8), 3).tolist() == [0, 1, 2]
