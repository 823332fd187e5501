"""Presses come back from their images, with intervals that keep their word and flags where they cannot."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.inversion.noise import Noise
from brushloop.model.inversion.press import Flag, Inverter, Known, Range
from brushloop.model.protocol import Basis
from brushloop.model.raster.compiled import coverage_numpy
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import stroke_models
from tests.model.inversion.autograd import invert_rendered

# torch's own forward mode compiles a part of itself with torch.jit, which it calls deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

PX = 0.25
SIDE = 128 * PX
ANCHOR = (0.8 * SIDE, 0.5 * SIDE)
BASIS = Basis(Brush())


def drawn(depth_mm: np.ndarray, tilt_deg: np.ndarray, place_mm: np.ndarray, heading_deg: np.ndarray, anchored: bool):
    mark = ccdbsm(Brush(), torch.from_numpy(depth_mm), torch.from_numpy(tilt_deg))
    ahead = depth_mm * np.tan(np.radians(tilt_deg)) if anchored else np.zeros(len(depth_mm))
    turn = np.radians(heading_deg)
    origin = place_mm + ahead[:, None] * np.column_stack((np.cos(turn), -np.sin(turn)))
    return coverage_numpy(mark, torch.from_numpy(origin), torch.from_numpy(heading_deg), px_mm=PX, threads=1)


def anchored(count: int, seed: int, tilts: tuple[float, float] = (0.0, 10.0)):
    rng = np.random.default_rng(seed)
    height, tilt = rng.uniform(11, 20, count), rng.uniform(*tilts, count)
    place = np.array(ANCHOR) + rng.uniform(-0.1, 0.1, (count, 2))
    return height, tilt, place, drawn(height, tilt, place, np.zeros(count), anchored=True)


def test_clean_images_give_the_press_exactly() -> None:
    height, tilt, place, images = anchored(60, 1)
    found = Inverter.of_brush(BASIS, px_mm=PX)(images, place)
    assert np.abs(found.depth_mm - height).max() < 1e-3
    assert np.abs(found.tilt_deg - tilt).max() < 0.05
    assert not any(flags & {Flag.ALPHA_UNKNOWN, Flag.DID_NOT_CONVERGE} for flags in found.flags)


@settings(max_examples=40, deadline=None)
@given(
    height=st.floats(4.0, 20.0),
    tilt=st.floats(0.0, 25.0),
    heading=st.floats(-180.0, 180.0),
    x=st.floats(-1.0, 1.0),
    y=st.floats(-1.0, 1.0),
)
@example(height=10.3125, tilt=20.0, heading=0.0, x=0.0, y=0.0)  # stretched and damped in turns, for ever
def test_place_and_heading_come_back_too(height: float, tilt: float, heading: float, x: float, y: float) -> None:
    turn = math.radians(heading)
    middle = 0.5 * height
    place = np.array([[0.5 * SIDE + x + middle * math.cos(turn), 0.5 * SIDE + y - middle * math.sin(turn)]])
    images = drawn(np.array([height]), np.array([tilt]), place, np.array([heading]), anchored=False)
    found = Inverter.of_brush(BASIS, known=Known.NOTHING, px_mm=PX)(images)
    assert found.depth_mm[0] == pytest.approx(height, abs=1e-3)
    assert found.tilt_deg[0] == pytest.approx(tilt, abs=0.05)
    assert found.values[0, 2:4] == pytest.approx(place[0], abs=1e-3)
    assert math.cos(math.radians(found.values[0, 4] - heading)) > 1 - 1e-6
    assert Flag.ALPHA_UNKNOWN in found.flags[0]


def test_binary_images_give_the_depth_to_a_fiftieth_of_a_millimetre() -> None:
    height, tilt, place, images = anchored(100, 2)
    found = Inverter.of_brush(BASIS, noise=Noise.QUANTISED, px_mm=PX)((images > 0.5).astype(np.float32), place)
    assert np.abs(found.depth_mm - height).mean() < 0.02
    for name, true in (("depth_mm", height), ("tilt_deg", tilt)):
        low, high = found.interval(name)
        assert 0.9 <= ((low <= true) & (true <= high)).mean() <= 1.0


def test_intervals_under_sensor_noise_keep_their_word() -> None:
    height, tilt, place, images = anchored(300, 3, (1.0, 10.0))
    noisy = images + np.random.default_rng(4).normal(0, 0.05, images.shape)
    found = Inverter.of_brush(BASIS, px_mm=PX)(noisy, place)
    for name, true in (("depth_mm", height), ("tilt_deg", tilt)):
        low, high = found.interval(name)
        assert 0.915 <= ((low <= true) & (true <= high)).mean() <= 0.98  # 95 % and three deviations of 300 draws


def test_the_best_press_of_a_grid_is_beside_the_fit() -> None:
    height, tilt, place, images = anchored(1, 5)
    target = (images > 0.5).astype(np.float32)
    found = Inverter.of_brush(BASIS, noise=Noise.QUANTISED, px_mm=PX)(target, place)
    steps = list(itertools.product(np.linspace(-0.1, 0.1, 21), np.linspace(-0.5, 0.5, 21)))
    near = found.values[:, :2] + np.array([(0.0, 0.0), *steps])
    grid = drawn(
        near[:, 0], np.maximum(near[:, 1], 0), np.repeat(place, len(near), 0), np.zeros(len(near)), anchored=True
    )
    cost = np.square(grid - target).sum(axis=(1, 2))
    assert cost[0] <= cost.min() * (1 + 1e-3)
    assert abs(near[np.argmin(cost), 0] - height[0]) < 0.05
    assert abs(near[np.argmin(cost), 1] - tilt[0]) < 0.5


@pytest.mark.parametrize("model", ["bezier", "ellipse"])
def test_any_model_inverts_its_own_marks(model: str) -> None:
    of = stroke_models(Brush())[model]
    height, tilt = torch.tensor([12.0, 16.0, 18.5]).double(), torch.tensor([2.0, 5.0, 9.0]).double()
    origin = torch.tensor(ANCHOR).double() + torch.stack((height * torch.tan(torch.deg2rad(tilt)), 0 * height), -1)
    images = coverage_numpy(of.profile(height, tilt), origin, px_mm=PX)
    found = Inverter.of_model(of, px_mm=PX)(images, ANCHOR)
    assert np.abs(found.depth_mm - height.numpy()).max() < 1e-3
    assert np.abs(found.tilt_deg - tilt.numpy()).max() < 0.05


def test_a_renderer_is_inverted_through_its_derivatives() -> None:
    """A network, not the formula: a layer of fixed waves behind the press, then a soft edge."""
    grid = (torch.arange(48).double() + 0.5) / 48 - 0.5
    radius = torch.sqrt(grid[:, None] ** 2 + 0.5 * grid[None, :] ** 2)

    def render(values: torch.Tensor) -> torch.Tensor:
        size = 0.015 * values[:, 0] * (1 + 0.2 * torch.tanh(values[:, 1] / 10))
        shift = 0.01 * values[:, 1]
        moved = radius[None] + 0.3 * shift[:, None, None] * grid[None, None, :]
        return torch.sigmoid((size[:, None, None] - moved) / 0.02)

    true = torch.tensor([[12.0, 3.0], [17.0, 8.0]]).double()
    found = invert_rendered(render, render(true).float().numpy(), Range((10.0, 20.0), (0.0, 10.0)))
    assert np.abs(found.values[:, :2] - true.numpy()).max() < 1e-2
    assert all(Flag.ALPHA_UNKNOWN in flags for flags in found.flags)


def test_the_exact_raster_as_a_renderer_agrees_with_the_fast_way() -> None:
    height, tilt, place, images = anchored(2, 6)
    place[1] = place[0]
    images = drawn(height, tilt, place, np.zeros(2), anchored=True)
    noisy = images + np.random.default_rng(0).normal(0, 0.05, images.shape).astype(np.float32)

    def render(values: torch.Tensor) -> torch.Tensor:
        h, a = values.unbind(-1)
        x = place[0, 0] + h * torch.tan(torch.deg2rad(a))
        return coverage_at(ccdbsm(Brush(), h, a), torch.stack((x, torch.full_like(x, place[0, 1])), -1), px_mm=PX)

    slow = invert_rendered(render, noisy, Range((10.0, 21.0), (0.0, 12.0)), anchored=True, px_mm=PX)
    fast = Inverter.of_brush(BASIS, within=Range((10.0, 21.0), (0.0, 12.0)), px_mm=PX)(noisy, place)
    # Either stops within a few hundredths of a standard deviation.
    assert np.all(np.abs(slow.values[:, :2] - fast.values[:, :2]) < 0.1 * fast.sigma[:, :2])
    assert np.allclose(slow.sigma[:, :2], fast.sigma[:, :2], rtol=0.02)


def test_an_uncertain_anchor_widens_the_interval_of_alpha() -> None:
    _, tilt, place, images = anchored(40, 7, (2.0, 10.0))
    off = np.random.default_rng(8).normal(0, 0.1, place.shape)
    found = Inverter.of_brush(BASIS, noise=Noise.QUANTISED, px_mm=PX, anchor_sigma_mm=0.1)(
        (images > 0.5).astype(np.float32), place + off
    )
    sure = Inverter.of_brush(BASIS, noise=Noise.QUANTISED, px_mm=PX)((images > 0.5).astype(np.float32), place)
    assert np.median(found.sigma[:, 1]) > 3 * np.median(sure.sigma[:, 1])
    low, high = found.interval("tilt_deg")
    assert ((low <= tilt) & (tilt <= high)).mean() >= 0.85


def test_flags_say_what_is_wrong() -> None:
    height, tilt, place, images = anchored(1, 9)
    invert = Inverter.of_brush(BASIS, px_mm=PX)
    blank = invert(np.zeros_like(images), place)
    assert Flag.BLANK in blank.flags[0]
    assert np.isnan(blank.depth_mm[0])
    shifted = np.array([[5.0, 0.5 * SIDE]])
    cut = invert(drawn(height, tilt, shifted, np.zeros(1), anchored=True), shifted)
    assert Flag.CUT in cut.flags[0]
    low = Inverter.of_brush(BASIS, px_mm=PX, within=Range((2.0, 10.0), (0.0, 10.0)))(images, place)
    assert Flag.AT_BOUND in low.flags[0]
    assert low.depth_mm[0] == 10.0


def test_an_upright_press_at_the_end_of_alphas_range_does_not_speak_against_the_model() -> None:
    place = anchored(1, 9)[2]
    height, tilt = np.array([15.0]), np.array([0.0])
    images = drawn(height, tilt, place, np.zeros(1), anchored=True)
    beside = place - np.array([[0.3, 0.0]])  # an anchor that is off, as if the brush leaned the other way
    found = Inverter.of_brush(BASIS, px_mm=PX)(images, beside)
    other = Inverter.of_brush(BASIS, px_mm=PX)(images, place + np.array([[0.3, 0.0]]))
    [flags] = found.flags if found.tilt_deg[0] == 0.0 else other.flags
    assert Flag.UPRIGHT in flags
    assert Flag.AT_BOUND not in flags


def test_without_an_anchor_alpha_can_be_held() -> None:
    height, _, _, images = anchored(1, 10, (5.0, 5.0))
    found = Inverter.of_brush(BASIS, known=Known.NOTHING, px_mm=PX, tilt_deg=0.0).assuming(5.0)(images)
    assert found.tilt_deg[0] == 5.0
    assert found.sigma[0, 1] == 0.0
    assert found.depth_mm[0] == pytest.approx(height[0], abs=1e-3)
    assert Flag.ALPHA_UNKNOWN in found.flags[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"within": Range((2.0, 30.0), (0.0, 5.0)), "tilt_deg": 6.0}, "tilt_deg = 6"),
        ({"anchor_sigma_mm": -1.0}, "anchor_sigma_mm = -1"),
    ],
)
def test_what_makes_no_sense_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Inverter.of_brush(BASIS, **options)


def test_images_and_places_are_checked() -> None:
    invert = Inverter.of_brush(BASIS)
    with pytest.raises(ValueError, match="expected \\(B, 128, 128\\)"):
        invert(np.zeros((1, 64, 64)), ANCHOR)
    with pytest.raises(ValueError, match="place_mm: expected one"):
        invert(np.zeros((1, 128, 128)))
    with pytest.raises(ValueError, match=r"expected 0\.001 <= low < high"):
        Range((5.0, 5.0))
