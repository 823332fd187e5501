"""Targets, the network in torch and in numpy, its loss, its file, and a generator as a stroke model."""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from brushloop.model.ccdbsm import Brush, DomainError, ccdbsm
from brushloop.model.generator import SHIPPED_GENERATOR, TrainError
from brushloop.model.generator.config import MAX_WEIGHTS, PRESETS, Layers, Target, preset
from brushloop.model.generator.data import sets, sha256
from brushloop.model.generator.network import Generator, covered, squared_error
from brushloop.model.generator.stroke import load_generator, read_generator, traced
from brushloop.model.generator.train import likeness
from brushloop.model.raster import centred_origin, coverage

MOST_BYTES = 10_000_000


def test_placements_are_those_of_the_validation() -> None:
    inputs, outline = np.array([[15.0, 8.0]]), ccdbsm(Brush(), 15.0, 8.0).outline()
    np.testing.assert_allclose(
        PRESETS["press"].images(inputs), coverage(outline, centred_origin(outline)), rtol=0, atol=1e-5
    )
    anchored = (0.76 * 38.4 + 15 * math.tan(math.radians(8)), 19.2)
    expected = coverage(outline, anchored, px_mm=0.3)
    np.testing.assert_allclose(PRESETS["anchored"].images(inputs), expected, rtol=0, atol=1e-5)
    for target in PRESETS.values():  # every stroke fits its image
        drawn = target.draw(64, (1,))
        ink_mm2 = target.images(drawn).sum((1, 2)) * target.px_mm**2
        assert ink_mm2.tolist() == pytest.approx(target.stroke_model.profile(*drawn.T).area_mm2.tolist(), rel=1e-3)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"depth_mm": (20, 11)}, r"depth_mm = \[20, 11\] must grow"),
        ({"tilt_deg": (-5, 10)}, "tilt_deg = -5 is outside"),
        ({"depth_mm": (11, 60)}, "depth_mm = 60 is outside"),
        ({"lam": 30}, "less than or equal to 10"),
        ({"model": "spline"}, "unknown stroke model 'spline'"),
    ],
)
def test_a_target_that_makes_no_sense_is_refused(fields: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Target(**fields)


def test_numpy_draws_what_torch_draws() -> None:
    file = read_generator(SHIPPED_GENERATOR)
    target, layers = file.config.target, file.config.layers
    network = Generator(target, layers)
    network.load_state_dict({name: torch.from_numpy(value) for name, value in file.weights.items()})
    inputs = target.draw(8, (0,))
    with torch.no_grad():
        np.testing.assert_allclose(file.images(inputs), network(torch.from_numpy(inputs)).numpy(), rtol=0, atol=1e-5)
    shapes = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    assert shapes == layers.shapes(target.size_px)
    with pytest.raises(ValueError, match="side = 16 does not divide size_px = 40"):
        Layers().shapes(40)


def test_the_loss_is_eq_6_and_its_gradient_passes_the_clamp() -> None:
    field = torch.tensor([[[-3.0, 0.1], [0.2, 4.0]]], requires_grad=True)
    wanted = torch.tensor([[[1.0, 0.5], [0.7, 1.0]]])
    loss = squared_error(field, wanted, ink_weight=3.0)
    weights = 1 + 2 * wanted
    assert loss.item() == pytest.approx((weights * (covered(field) - wanted) ** 2).sum().item())
    loss.backward()
    assert field.grad is not None
    torch.testing.assert_close(field.grad, 2 * weights * (covered(field.detach()) - wanted))
    assert field.grad[0, 0, 0] == -6  # far on the wrong side, and still pulled back
    assert field.grad[0, 1, 1] == 0


def test_a_generator_is_a_stroke_model_that_calls_itself_what_it_is() -> None:
    model = load_generator(SHIPPED_GENERATOR)
    assert (model.name, model.label, model.fitted) == ("ccd-bsmg", "CCD-BSMG", False)
    assert "trained on exact images of CCD-BSM" in model.definition
    depths, tilts = np.array([11.0, 12.0, 19.0, 20.0]), np.array([0.0, 5.0, 5.0, 10.0])
    outline, exact = model.profile(depths, tilts), ccdbsm(Brush(), depths, tilts).outline()
    np.testing.assert_allclose(outline.area_mm2, exact.area_mm2, rtol=5e-3)
    np.testing.assert_allclose(outline.x_max_mm, exact.x_max_mm, atol=0.1)
    assert (outline.x_min_mm - exact.x_min_mm < 1.0).all()  # the tip ends where it is half a pixel wide
    origin = centred_origin(exact)
    assert likeness(coverage(outline, origin), coverage(exact, origin))[:, 1].min() > 0.98
    with pytest.raises(DomainError, match=r"depth_mm = 25 is outside \[11, 20\] mm"):
        model.profile(25.0, 5.0)
    with pytest.raises(TrainError, match="was trained for a brush with radius_mm = 6, not 5"):
        load_generator(SHIPPED_GENERATOR, Brush(5.0))
    with pytest.raises(ValueError, match="draws no ink"):
        traced(np.zeros((1, 16, 16), np.float32), np.zeros((1, 2)), 0.2)


def test_the_shipped_generator_is_small_and_the_one_that_its_card_describes() -> None:
    assert SHIPPED_GENERATOR.stat().st_size <= MOST_BYTES
    card, file = SHIPPED_GENERATOR.with_suffix(".md").read_text(encoding="utf-8"), read_generator(SHIPPED_GENERATOR)
    assert sha256(SHIPPED_GENERATOR) in card
    assert "trained on exact area coverage of the stroke model `ccd-bsm`" in card
    assert "It has seen no real ink" in card
    assert f"{file.report['mse']:.3g}" in card
    assert file.config == preset("anchored")  # the documented command trains it
    held_out = sets(file.config.model_copy(update={"seed": 1, "training_images": 1, "validation_images": 64}))[1]
    inputs, target = held_out.pick(np.arange(64))
    mse = float(np.square(file.images(inputs) - target).mean())
    assert 0.5 * file.report["mse"] < mse < 2.0 * file.report["mse"]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    path = tmp_path / "generator.safetensors"
    path.write_bytes(SHIPPED_GENERATOR.read_bytes())
    return path


def changed(path: Path, tensors: dict[str, np.ndarray] | None = None, **metadata: str) -> None:
    with safe_open(path, framework="np") as file:
        before = file.metadata()
    save_file(load_file(path) | (tensors or {}), path, before | metadata)


def configured(**layers: int) -> str:
    return json.dumps({"target": {}, "layers": layers})


BIAS = "convolution.0.bias"
HOSTILE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "text": (lambda p: p.write_text("hello"), "is not a safetensors file"),
    "endless header": (lambda p: p.write_bytes(struct.pack("<Q", 2**60) + b"{}"), "is not a safetensors file"),
    "huge": (lambda p: os.truncate(p, 4 * MAX_WEIGHTS + 2**26 + 1), "bytes; at most"),
    "another kind": (lambda p: changed(p, format="other"), "format is 'other'"),
    "no config": (lambda p: changed(p, config=""), "config is not JSON"),
    "unknown field": (lambda p: changed(p, config=json.dumps({"target": {"evil": 1}})), "evil: Extra inputs"),
    "many weights": (lambda p: changed(p, config=configured(width=2048, channels=128, side=64)), "weights; at most"),
    "shape": (lambda p: changed(p, {BIAS: np.zeros(17, np.float32)}), "expected float32 (64,)"),
    "not finite": (lambda p: changed(p, {BIAS: np.full(64, np.nan, np.float32)}), "not finite"),
    "one too many": (lambda p: changed(p, {"more": np.zeros(1, np.float32)}), "'more' is not known"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_is_no_generator_is_refused_in_one_line(copy: Path, kind: str) -> None:
    damage, words = HOSTILE[kind]
    damage(copy)
    with pytest.raises(TrainError) as caught:
        read_generator(copy)
    assert words in str(caught.value)
    assert str(copy) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2
