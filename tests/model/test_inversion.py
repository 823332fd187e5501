"""Presses come back from their images, with intervals that keep their word and flags where they cannot."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from brushloop.calibrate.stats import NORMAL_95
from brushloop.model.ccdbsm import Brush
from brushloop.model.inversion import PARAMETERS, Flag, Inverter, Range
from brushloop.model.outline import Outline
from brushloop.model.strokes import StrokeModel, stroke_models

PX = 0.25
SIDE = 128 * PX
ANCHOR = (0.8 * SIDE, 0.5 * SIDE)
MODELS = stroke_models(Brush())
INVERT = Inverter(MODELS["ccd-bsm"], px_mm=PX)
UNSURE = Inverter(MODELS["ccd-bsm"], px_mm=PX, anchor_sigma_mm=0.1)


def drawn(depth_mm, tilt_deg, place_mm, heading_deg=0.0, model: StrokeModel = MODELS["ccd-bsm"]) -> np.ndarray:
    columns = np.broadcast_arrays(depth_mm, tilt_deg, *np.transpose(place_mm))
    return Inverter(model, px_mm=PX).predict(np.column_stack(columns), heading_deg, PX)


def anchored(count: int, seed: int, tilts: tuple[float, float] = (0.0, 10.0)):
    rng = np.random.default_rng(seed)
    depth, tilt = rng.uniform(11, 20, count), rng.uniform(*tilts, count)
    place = np.array(ANCHOR) + rng.uniform(-0.1, 0.1, (count, 2))
    return depth, tilt, place, drawn(depth, tilt, place)


def inside(recovered, name: str, true: np.ndarray) -> float:
    k = PARAMETERS.index(name)
    return float((np.abs(recovered.values[:, k] - true) <= NORMAL_95 * recovered.sigma[:, k]).mean())


@settings(max_examples=25, deadline=None)
@given(st.floats(4.0, 20.0), st.floats(0.0, 25.0), st.floats(-180.0, 180.0))
@example(10.3125, 20.0, 0.0)
def test_a_press_of_any_heading_comes_back_from_an_uncertain_place(depth: float, tilt: float, heading: float) -> None:
    turn, ahead = math.radians(heading), depth * (0.5 - math.tan(math.radians(tilt)))
    place = np.array([[0.5 * SIDE + ahead * math.cos(turn), 0.5 * SIDE - ahead * math.sin(turn)]])
    recovered = UNSURE(drawn(depth, tilt, place, heading), place + 0.05, heading)
    assert recovered.depth_mm[0] == pytest.approx(depth, abs=1e-3)
    assert recovered.tilt_deg[0] == pytest.approx(tilt, abs=0.05)
    assert recovered.values[0, 2:] == pytest.approx(place[0], abs=0.02)


@pytest.mark.parametrize("model", ["ccd-bsm", "bezier", "qbc"])
def test_any_model_inverts_its_own_marks(model: str) -> None:
    depth, tilt = np.array([12.0, 16.0, 18.5]), np.array([2.0, 5.0, 9.0])
    images = drawn(depth, tilt, [ANCHOR] * 3, model=MODELS[model])
    recovered = Inverter(MODELS[model], px_mm=PX)(images, ANCHOR)
    assert np.abs(recovered.depth_mm - depth).max() < 1e-3
    assert np.abs(recovered.tilt_deg - tilt).max() < 0.05
    assert not any(Flag.DID_NOT_CONVERGE in flags for flags in recovered.flags)


def test_intervals_under_sensor_noise_keep_their_word() -> None:
    depth, tilt, place, images = anchored(200, 3, (1.0, 10.0))
    noisy = images + np.random.default_rng(4).normal(0, 0.05, images.shape)
    recovered = INVERT(noisy, place)
    assert 0.92 <= inside(recovered, "depth_mm", depth) <= 0.98
    assert 0.92 <= inside(recovered, "tilt_deg", tilt) <= 0.98


def test_an_uncertain_anchor_widens_the_interval_of_alpha() -> None:
    _, tilt, place, images = anchored(40, 7, (2.0, 10.0))
    binary, off = (images > 0.5).astype(np.float32), np.random.default_rng(8).normal(0, 0.1, place.shape)
    recovered, sure = UNSURE(binary, place + off), INVERT(binary, place)
    assert np.median(recovered.sigma[:, 1]) > 3 * np.median(sure.sigma[:, 1])
    assert inside(recovered, "tilt_deg", tilt) >= 0.85
    assert not any(Flag.DID_NOT_CONVERGE in flags for flags in recovered.flags)
    nearly_sure = Inverter(MODELS["ccd-bsm"], px_mm=PX, anchor_sigma_mm=1e-4)(binary, place)
    assert np.abs(nearly_sure.tilt_deg - sure.tilt_deg).max() < 0.01


@pytest.mark.parametrize("other", [Brush(6.6, 48.0), Brush(6.0, 45.0)], ids=["wider", "shorter"])
def test_the_misfit_of_a_model_does_not_move_a_place_that_is_known_and_so_not_alpha(other: Brush) -> None:
    depth, tilt = np.array([13.0, 17.0, 20.0]), np.array([5.0, 10.0, 0.0])
    recovered = UNSURE(drawn(depth, tilt, np.tile(ANCHOR, (3, 1)), model=stroke_models(other)["ccd-bsm"]), ANCHOR)
    assert recovered.tilt_deg == pytest.approx(tilt, abs=1.0)
    assert recovered.values[:, 2:] == pytest.approx(np.tile(ANCHOR, (3, 1)), abs=0.2)


def test_flags_say_what_is_wrong() -> None:
    depth, tilt, place, images = anchored(1, 9)
    blank = INVERT(np.zeros_like(images), place)
    assert Flag.BLANK in blank.flags[0]
    assert np.isnan(blank.depth_mm[0])
    shifted = np.array([[5.0, 0.5 * SIDE]])
    assert Flag.CUT in INVERT(drawn(depth, tilt, shifted), shifted).flags[0]
    low = Inverter(MODELS["ccd-bsm"], Range((2.0, 10.0), (0.0, 10.0)), px_mm=PX)(images, place)
    assert Flag.AT_BOUND in low.flags[0]
    assert low.depth_mm[0] == 10.0
    # An upright press, as if the brush leaned the other way: the end of alpha's range does not speak against the model.
    upright, place = drawn(15.0, 0.0, [ANCHOR]), np.array([ANCHOR])
    off = [INVERT(upright, place + np.array([beside, 0.0])) for beside in (-0.3, 0.3)]
    [flags] = [recovered.flags[0] for recovered in off if recovered.tilt_deg[0] == 0.0]
    assert Flag.UPRIGHT in flags
    assert not flags & {Flag.AT_BOUND, Flag.DID_NOT_CONVERGE}


def test_an_interval_holds_both_of_two_tilts_that_leave_the_same_mark() -> None:
    plain = MODELS["ccd-bsm"]

    def profile(depth_mm: np.ndarray, tilt_deg: np.ndarray) -> Outline:
        alike = np.abs(tilt_deg - 7.0)
        outline = plain.profile(depth_mm, alike)
        ahead = depth_mm * (np.tan(np.radians(alike)) - np.tan(np.radians(tilt_deg)))
        outline.points[..., 0] += ahead[:, None, None]
        return outline

    inverter = Inverter(replace(plain, profile=profile), px_mm=PX)
    recovered = inverter(inverter.predict(np.array([[15.0, 2.0, *ANCHOR]]), 0.0, PX), ANCHOR)
    [tilt_deg], [sd_deg] = recovered.tilt_deg, recovered.sigma[:, 1]
    assert min(abs(tilt_deg - 2.0), abs(tilt_deg - 12.0)) < 0.1
    assert sd_deg == pytest.approx(10.0, abs=0.2)
