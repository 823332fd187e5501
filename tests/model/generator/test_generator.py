"""Targets, network, loss, and a generator as a stroke model."""

from __future__ import annotations

import math

import pytest
import torch

from brushloop.model.brush import Brush, DomainError
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.generator.metrics import quality
from brushloop.model.generator.network import Generator, Inputs, Layers, chebyshev, covered, squared_error
from brushloop.model.generator.stroke import generator_model, traced
from brushloop.model.generator.targets import PRESETS, Placement, Target
from brushloop.model.raster.exact import coverage_at
from brushloop.model.raster.frame import centred_origin
from brushloop.model.strokes import stroke_model

SMALL = Layers(width=16, channels=4, side=8, size_px=32)


def target(name: str = "press") -> Target:
    chosen = PRESETS[name]
    return Target(stroke_model(chosen.model, Brush()), chosen.ranges, chosen.fixed, chosen.placement, chosen.px_mm)


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_draws_strokes_that_fit_the_image(name: str) -> None:
    strokes = target(name)
    inputs = strokes.draw(64, torch.Generator().manual_seed(1))
    assert inputs.shape == (64, len(strokes.ranges))
    for spec, column in zip(strokes.inputs, inputs.T, strict=True):
        spec.check(column)
    images = strokes.images(inputs)
    assert images.shape == (64, 128, 128)
    assert (images.sum((1, 2)) * strokes.px_mm**2).tolist() == pytest.approx(
        strokes.shape(inputs).area_mm2.tolist(), rel=1e-3
    )


def test_placements_are_those_of_the_validation() -> None:
    inputs = torch.tensor([[15.0, 8.0]])
    mark = ccdbsm(Brush(), 15.0, 8.0)
    torch.testing.assert_close(
        target().images(inputs).double(), coverage_at(mark, centred_origin(mark)), rtol=0, atol=1e-5
    )
    anchored = (0.76 * 38.4 + 15 * math.tan(math.radians(8)), 19.2)
    expected = coverage_at(mark, anchored, px_mm=0.3)
    torch.testing.assert_close(target("anchored").images(inputs).double(), expected, rtol=0, atol=1e-5)
    every = torch.tensor([[48.0, 6.0, 15.0, 8.0, 28.0, 18.0]])
    expected = coverage_at(mark, (28.0, 18.0), px_mm=0.3)
    torch.testing.assert_close(target("all").images(every).double(), expected, rtol=0, atol=1e-5)


def test_strokes_that_the_model_refuses_are_not_drawn() -> None:
    qbc = stroke_model("qbc", Brush())
    fat = PRESETS["qbc"].ranges | {"end_width_mm": (1.0, 24.0)}
    strokes = Target(qbc, fat, PRESETS["qbc"].fixed, Placement.BASE)
    drawn = strokes.draw(100, torch.Generator().manual_seed(0))
    assert len(drawn) == 100
    strokes.shape(drawn)
    assert torch.equal(drawn, strokes.draw(100, torch.Generator().manual_seed(0)))
    hopeless = Target(qbc, fat | {"end_width_mm": (60.0, 80.0)}, PRESETS["qbc"].fixed, Placement.BASE)
    with pytest.raises(ValueError, match="refuses nine of ten"):
        hopeless.draw(10, torch.Generator())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ranges": {"height": (1, 2)}}, "ranges.height: ccd-bsm knows depth_mm"),
        ({"ranges": {"depth_mm": (20, 11)}}, "must grow within"),
        ({"ranges": {}}, "ranges is empty"),
        ({"fixed": {"depth_mm": 3}}, "fixed.depth_mm: not a parameter"),
        ({"fixed": {"lam": 30}}, "fixed.lam = 30 is outside"),
        ({"model": stroke_model("circle", Brush()), "ranges": {"radius_mm": (1, 2)}}, "circle does not have"),
    ],
)
def test_a_target_that_makes_no_sense_is_refused(changes: dict, words: str) -> None:
    press = PRESETS["press"]
    fields = {"model": stroke_model("ccd-bsm", Brush()), "ranges": press.ranges, "placement": Placement.ZERO_TOUCH}
    with pytest.raises(ValueError, match=words):
        Target(**fields | changes)


def test_chebyshev_polynomials_are_cosines() -> None:
    angle = torch.linspace(0, math.pi, 50, dtype=torch.float64)
    expected = torch.stack([torch.cos(k * angle) for k in range(6)], dim=-1)
    torch.testing.assert_close(chebyshev(torch.cos(angle), 5), expected, rtol=0, atol=1e-12)


def test_the_network_is_differentiable_in_its_inputs() -> None:
    torch.manual_seed(0)
    network = Generator(target().inputs, SMALL).double()
    inputs = torch.tensor([[13.3, 4.0], [17.0, 9.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: network(values).mean((1, 2)), (inputs,), eps=1e-6, atol=1e-6)
    assert network(inputs).shape == (2, 32, 32)
    with pytest.raises(ValueError, match="not a multiple"):
        Layers(side=16, size_px=40)


def test_the_loss_is_eq_6_and_its_gradient_passes_the_clamp() -> None:
    field = torch.tensor([[[-3.0, 0.1], [0.2, 4.0]]], requires_grad=True)
    wanted = torch.tensor([[[1.0, 0.5], [0.7, 1.0]]])
    loss = squared_error(field, wanted, ink_weight=3.0)
    weights = 1 + 2 * wanted
    assert loss.item() == pytest.approx((weights * (covered(field) - wanted) ** 2).sum().item())
    loss.backward()
    assert field.grad is not None
    expected = 2 * weights * (covered(field.detach()) - wanted)
    torch.testing.assert_close(field.grad, expected)
    assert field.grad[0, 0, 0] == -6  # far on the wrong side, and still pulled back
    assert field.grad[0, 1, 1] == 0


def test_a_generator_is_a_stroke_model() -> None:
    strokes = target()

    class Perfect(Generator):
        def forward(self, values: torch.Tensor) -> torch.Tensor:
            return strokes.images(values)

    model = generator_model(Perfect(strokes.inputs, SMALL), strokes)
    assert (model.name, model.label, model.fitted) == ("ccd-bsmg", "CCD-BSMG", False)
    assert [spec.name for spec in model.parameters] == ["depth_mm", "tilt_deg"]
    shape = model.profile(torch.tensor([12.0, 19.0]), 5.0)
    exact = ccdbsm(Brush(), torch.tensor([12.0, 19.0]), 5.0)
    torch.testing.assert_close(shape.area_mm2, exact.area_mm2.double(), rtol=5e-3, atol=0)
    torch.testing.assert_close(shape.x_max_mm, exact.x_max_mm.double(), rtol=0, atol=0.1)
    assert ((shape.x_min_mm - exact.x_min_mm) < 1.0).all()  # the tip ends where it is half a pixel wide
    origin = centred_origin(exact)
    drawn, expected = coverage_at(shape, origin), coverage_at(exact, origin)
    assert quality([(drawn, expected)]).iou > 0.985
    assert model.images({"depth_mm": 15.0, "tilt_deg": 3.0}).shape == (1, 128, 128)
    with pytest.raises(DomainError, match=r"depth_mm = 25 is outside \[11, 20\] mm"):
        model.profile(25.0, 5.0)
    with pytest.raises(ValueError, match="no parameter 'speed'"):
        model.shape({"speed": 1.0})


def test_a_generator_of_another_brush_says_so() -> None:
    fixed = {"radius_mm": 5.0}
    strokes = Target(stroke_model("ccd-bsm", Brush()), PRESETS["press"].ranges, fixed)
    model = generator_model(Generator(strokes.inputs, Layers()), strokes)
    with pytest.raises(DomainError, match="radius_mm = 6 is outside the 5 it was trained with"):
        model.of_press(15.0, 5.0)


def test_a_blank_image_has_no_outline() -> None:
    with pytest.raises(ValueError, match="draws no ink"):
        traced(torch.zeros(1, 16, 16), torch.zeros(1, 2), 0.2)


def test_inputs_are_scaled_to_one() -> None:
    inputs = Inputs(target().inputs)
    torch.testing.assert_close(inputs(torch.tensor([[11.0, 10.0], [15.5, 5.0]])), torch.tensor([[-1.0, 1.0], [0, 0]]))


def test_equal_images_are_perfect() -> None:
    images = target().images(torch.tensor([[15.0, 5.0], [12.0, 1.0]]))
    found = quality([(images, images)])
    assert (found.images, found.mse, found.iou, found.psnr_db) == (2, 0, 1, math.inf)
    assert found.csim == pytest.approx(1)
    assert found.ssim_min == pytest.approx(1)
    with pytest.raises(ValueError, match="no images"):
        quality([])
