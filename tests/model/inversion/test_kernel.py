"""The compiled normal equations say what autograd says, for every model, and jets are derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.inversion.forward import PARAMETERS, Outlines
from brushloop.model.inversion.jets import analytic, of_model
from brushloop.model.outline import Outline
from brushloop.model.protocol import Basis
from brushloop.model.raster.exact import coverage_at
from brushloop.model.strokes import stroke_models
from tests.model.inversion.autograd import Rendered

# torch's own forward mode compiles a part of itself with torch.jit, which it calls deprecated.
pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")

SIZE, PX = 64, 0.5
HELD = np.array([[15.0, 5.0, 22.0, 15.0, 20.0]])
MODELS = stroke_models(Brush())


def rendered(model: str, anchored: bool) -> Rendered:
    def render(values: torch.Tensor) -> torch.Tensor:
        height, tilt, x, y, heading = values.unbind(-1)
        ahead = height * torch.tan(torch.deg2rad(tilt)) if anchored else torch.zeros_like(height)
        turn = torch.deg2rad(heading)
        origin = torch.stack((x + ahead * torch.cos(turn), y - ahead * torch.sin(turn)), dim=-1)
        return coverage_at(MODELS[model].profile(height, tilt), origin, heading, size_px=SIZE, px_mm=PX)

    return Rendered(render, PARAMETERS)


@pytest.mark.parametrize("anchored", [True, False])
@pytest.mark.parametrize("model", ["ccd-bsm", "bezier", "ellipse", "line-tapered", "qbc"])
def test_the_normal_equations_are_those_of_autograd(model: str, anchored: bool) -> None:
    values = np.array([[14.0, 4.0, 22.0, 15.0, 20.0], [11.0, 9.0, 20.0, 14.0, -70.0], [17.0, 0.5, 12.0, 17.0, 175.0]])
    target = np.random.default_rng(0).random((3, SIZE, SIZE)).astype(np.float32)
    row = np.arange(3)
    fast = Outlines(of_model(MODELS[model]), PARAMETERS, HELD, anchored, SIZE, PX).normal(values, target, row)
    slow = rendered(model, anchored).normal(values, target, row)
    for name in ("hessian", "gradient", "cost", "meat", "cut"):
        mine, theirs = getattr(fast, name), getattr(slow, name)
        assert np.allclose(mine, theirs, rtol=2e-3, atol=2e-4 * np.abs(theirs).max()), name


def test_the_closed_form_is_the_derivative_of_the_model() -> None:
    height, tilt = np.array([5.0, 13.0, 20.0]), np.array([0.0, 7.0, 25.0])
    closed, forward = analytic(6.0, 48.0, math.pi)(height, tilt), of_model(MODELS["ccd-bsm"])(height, tilt)
    for name in ("points", "weights", "velocities", "rates"):
        assert np.allclose(getattr(closed, name), getattr(forward, name), atol=1e-12), name


def test_a_model_without_gradients_is_differentiated_by_differences() -> None:
    class Numb:
        """CCD-BSM, its outlines cut off from their parameters."""

        def profile(self, height: torch.Tensor, tilt: torch.Tensor) -> Outline:
            made = ccdbsm(Brush(), height.detach().clone(), tilt.detach().clone()).outline()
            return Outline(*(torch.from_numpy(part.numpy().copy()) for part in (made.points, made.weights)))

    height, tilt = np.array([5.0, 13.0, 20.0]), np.array([0.0, 7.0, 25.0])
    numb, closed = of_model(Numb())(height, tilt), analytic(6.0, 48.0, math.pi)(height, tilt)  # pyright: ignore[reportArgumentType]
    assert np.allclose(numb.points, closed.points)
    assert np.allclose(numb.velocities, closed.velocities, atol=1e-4)


def test_a_mark_outside_the_image_has_no_derivatives_there() -> None:
    forward = Outlines(analytic(6.0, 48.0, math.pi), PARAMETERS, HELD, False, SIZE, PX)
    away = forward.normal(
        np.array([[15.0, 5.0, 200.0, 15.0, 0.0]]), np.zeros((1, SIZE, SIZE), np.float32), np.array([0])
    )
    assert not away.hessian.any()
    assert away.cost[0] == 0.0


def test_a_held_parameter_is_that_of_its_own_image() -> None:
    held = np.repeat(HELD, 2, axis=0)
    held[1, 2] += 3.0
    forward = Outlines(analytic(6.0, 48.0, math.pi), PARAMETERS[:2], held, False, SIZE, PX)
    press = np.array([[15.0, 5.0]])
    first, second = (forward.of(np.array([k])).predict(press)[0] for k in (0, 1))
    assert np.allclose(np.roll(first, 6, axis=1), second, atol=1e-6)
    mark = ccdbsm(Basis(Brush()).brush, 15.0, 5.0)
    drawn = coverage_at(mark, (22.0, 15.0), 20.0, size_px=SIZE, px_mm=PX)[0].numpy()
    assert np.allclose(first, drawn, atol=1e-5)
