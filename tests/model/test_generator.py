"""Targets, the network in torch and in numpy, and its file; `brushloop train`, its folder, and what a cut does."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from brushloop.model.ccdbsm import Brush, DomainError, ccdbsm
from brushloop.model.generator import SHIPPED_GENERATOR, TrainError
from brushloop.model.generator import train as training
from brushloop.model.generator.config import (
    MAX_WEIGHTS,
    PRESETS,
    Layers,
    Target,
    TrainConfig,
    checked,
    load_config,
    preset,
)
from brushloop.model.generator.data import Images, sets, sha256, split
from brushloop.model.generator.network import Generator, covered, squared_error
from brushloop.model.generator.stroke import load_generator, read_generator, traced
from brushloop.model.generator.train import likeness, new_network, run_training
from brushloop.model.raster import centred_origin, coverage
from tests.command import refused, said

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
        ({"depth_mm": (20, 11)}, r"depth_mm = \[20, 11\] must increase"),
        ({"tilt_deg": (-5, 10)}, "tilt_deg = -5 is outside"),
        ({"depth_mm": (11, 60)}, "depth_mm = 60 is outside"),
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
def test_what_is_no_generator_is_refused_in_one_line(tmp_path: Path, kind: str) -> None:
    (damage, words), copy = HOSTILE[kind], tmp_path / "generator.safetensors"
    copy.write_bytes(SHIPPED_GENERATOR.read_bytes())
    damage(copy)
    with pytest.raises(TrainError) as caught:
        read_generator(copy)
    assert words in str(caught.value)
    assert str(copy) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


# `brushloop train`

TOML = """
training_images = 96
validation_images = 16
batch = 16
steps = 30
validate_every = 10
picture_every = 15
[target]
px_mm = 0.8
size_px = 32
[layers]
width = 16
channels = 4
side = 8
"""


@pytest.fixture(scope="module")
def toml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training so small that it takes a second."""
    path = tmp_path_factory.mktemp("tiny") / "train.toml"
    path.write_text(TOML)
    return path


@pytest.fixture
def tiny(toml: Path) -> TrainConfig:
    return load_config(toml)


@pytest.fixture(scope="module")
def finished(toml: Path) -> Path:
    """The folder of a training that nobody disturbed."""
    said("train", "--config", toml, "--out", toml.parent / "g")
    return toml.parent / "g"


def curve(folder: Path, name: str = "loss.csv") -> list[tuple[int, float]]:
    with (folder / name).open() as file:
        return [(int(step), float(value)) for step, value in list(csv.reader(file))[1:]]


def test_it_learns_until_it_is_good_enough_and_shows_pictures_every_m_steps(tmp_path: Path, tiny: TrainConfig) -> None:
    changes = {"steps": 120, "validate_every": 40, "learning_rate": 0.02, "target_mse": 0.1}
    config, steps = tiny.model_copy(update=changes), list[int]()
    report = read_generator(run_training(config, tmp_path, steps.append)).report
    losses, checks = curve(tmp_path), curve(tmp_path, "validation.csv")
    assert [step for step, _ in losses] == steps
    assert losses[-1][1] < 0.4 * losses[0][1]
    assert [step for step, _ in checks] == list(range(40, len(steps) + 1, 40))
    assert checks[-1][1] == pytest.approx(report["mse"])
    assert report["iou"] > 0.5
    assert report["end"] == ("converged" if len(steps) < 120 else "all steps done")
    assert len(list((tmp_path / "pictures").iterdir())) == len(steps) // 15


def test_the_command_leaves_generator_card_and_page_that_say_that_there_is_no_ink(finished: Path) -> None:
    left = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()} - {".lock"}
    files = {"checkpoint.pt", "generator.safetensors", "generator.md", "training.html", "loss.csv", "validation.csv"}
    assert left == files | {f"pictures/step-{step:07d}.png" for step in (15, 30)}
    card = (finished / "generator.md").read_text()
    assert "H from 11 to 20 mm, alpha from 0 to 10 deg" in card
    assert "The network saw no real ink" in card
    assert "30 steps of 16, seed 0, highest rate 0.005: all steps done" in card
    page = (finished / "training.html").read_text(encoding="utf-8")
    assert page.count('alt="network: depth_mm ') == 12
    assert '<span class="source">exact images of a stroke model</span>' in page
    assert re.findall(r"(?:src|href)=\"(?!data:|#)", page) == []


class PowerCut(BaseException):
    pass


@pytest.mark.parametrize("last", [3, 20])
def test_cut_off_and_resumed_it_ends_like_one_that_was_not(
    tmp_path: Path, tiny: TrainConfig, finished: Path, last: int
) -> None:
    def cut(step: int) -> None:
        if step == last:
            raise PowerCut

    with pytest.raises(PowerCut):
        run_training(tiny, tmp_path, cut)
    assert not (tmp_path / "generator.safetensors").exists()
    again: list[int] = []
    run_training(tiny, tmp_path, again.append)
    assert again == list(range(last - last % 10 + 1, 31))
    np.testing.assert_allclose(curve(tmp_path), curve(finished), rtol=1e-4)


def test_a_finished_training_is_not_done_again_and_another_one_is_refused(
    finished: Path, tiny: TrainConfig, tmp_path: Path
) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.glob("*.*") if path.name != ".lock"}
    run_training(tiny, finished, pytest.fail)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with pytest.raises(TrainError, match="another configuration: steps: 30 -> 40; use a new folder"):
        run_training(tiny.model_copy(update={"steps": 40}), finished, pytest.fail)
    with FileLock(tmp_path / ".lock"), pytest.raises(TrainError, match="another training writes in this folder"):
        run_training(tiny, tmp_path, pytest.fail)
    (tmp_path / "checkpoint.pt").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(TrainError, match=r"is not a checkpoint of this training: [^\n]*$"):
        run_training(tiny, tmp_path, pytest.fail)


@pytest.mark.parametrize(("bias", "words"), [(-100.0, ": 0.00% of the .* ink_weight"), (100.0, "100.00% of the"),
                                             (math.nan, "step 1: the loss is no longer a number")])  # fmt: skip
def test_blank_output_ends_the_training_with_advice(
    tmp_path: Path, tiny: TrainConfig, monkeypatch: pytest.MonkeyPatch, bias: float, words: str
) -> None:
    def biased(config: TrainConfig) -> Generator:
        network = new_network(config)
        torch.nn.init.constant_(network.convolution[0].bias, bias)
        return network

    monkeypatch.setattr(training, "new_network", biased)
    with pytest.raises(TrainError, match=words):
        run_training(tiny.model_copy(update={"learning_rate": 1e-9}), tmp_path, lambda step: None)


def test_repeats_of_a_condition_are_held_out_together(tiny: TrainConfig) -> None:
    inputs = np.column_stack((np.repeat(np.arange(11.0, 17.0), 4), np.full(24, 5.0))).astype(np.float32)
    captures = Images(tiny.target, inputs, np.zeros((24, 32, 32), np.float32))
    for seed in range(5):
        kept, held = split(captures, seed, 0.3)
        assert (len(kept), len(held)) == (16, 8)
        assert not set(held.inputs[:, 0].tolist()) & set(kept.inputs[:, 0].tolist())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--target", "cube"], "cube: no such target; known: press, anchored"),
        (["--config", "no.toml"], "no.toml: No such file"),
        (["tune", "no.safetensors", "nowhere"], "no.safetensors: no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], words: str) -> None:
    assert words in refused("train", *arguments)
    with pytest.raises(TrainError, match=r"train.toml: steps: Input should be greater than or equal to 1"):
        checked("train.toml", {"steps": 0})
