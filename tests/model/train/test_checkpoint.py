"""Files from elsewhere: only what is exactly a checkpoint, a generator or captures is read."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from brushloop.model.train import checkpoint
from brushloop.model.train.checkpoint import load_checkpoint, load_weights, save_checkpoint, save_generator
from brushloop.model.train.config import TrainConfig
from brushloop.model.train.data import load_captures, save_captures, split
from brushloop.model.train.errors import TrainError
from brushloop.model.train.loop import new_state


@pytest.fixture
def good(tmp_path: Path, tiny: TrainConfig) -> Path:
    path = tmp_path / "checkpoint.safetensors"
    save_checkpoint(path, tiny, new_state(tiny))
    return path


def changed(path: Path, tensors: dict[str, torch.Tensor] | None = None, **metadata: str) -> None:
    with safe_open(path, framework="pt") as file:
        before = file.metadata()
    save_file(load_file(path) | (tensors or {}), path, before | metadata)


def test_a_checkpoint_comes_back_whole(good: Path, tiny: TrainConfig) -> None:
    config, state = load_checkpoint(good)
    assert config == tiny
    assert state.step == 0
    for name, weight in new_state(tiny).weights.items():
        assert torch.equal(state.weights[name], weight)


BIAS = "weights.convolution.0.bias"
HOSTILE: dict[str, tuple[Callable[[Path], Any], str]] = {
    "absent": (Path.unlink, "no such file"),
    "text": (lambda p: p.write_text("hello"), "is not a safetensors file"),
    "pickle": (lambda p: torch.save({"a": torch.zeros(1)}, p), "is not a safetensors file"),
    "cut": (lambda p: p.write_bytes(p.read_bytes()[:-100]), "is not a safetensors file"),
    "endless header": (lambda p: p.write_bytes(struct.pack("<Q", 2**60) + b"{}"), "is not a safetensors file"),
    "large header": (
        lambda p: p.write_bytes(struct.pack("<Q", 5 * 2**20) + b'{"__metadata__":{}}'.ljust(5 * 2**20)),
        "at most 4,194,304 are read",
    ),
    "another kind": (lambda p: changed(p, format="brushloop-generator-1"), "format is 'brushloop-generator-1'"),
    "no config": (lambda p: changed(p, config=""), "config is not JSON"),
    "deep config": (lambda p: changed(p, config="[" * 60_000), "config is not JSON"),
    "long config": (lambda p: changed(p, config=" " * 70_000), "config is longer than"),
    "unknown field": (
        lambda p: changed(p, config=json.dumps({"evil": 1, "target": {}})),
        "target.ranges: Field required",
    ),
    "step": (lambda p: changed(p, step="31"), "step = '31' is not a number from 0 to 30"),
    "step in words": (lambda p: changed(p, step="1e9"), "step = '1e9'"),
    "history": (lambda p: changed(p, step="5"), "history.losses is not 5"),
    "shape": (lambda p: changed(p, {BIAS: torch.zeros(17)}), "expected float32 (16,)"),
    "type": (lambda p: changed(p, {BIAS: torch.zeros(16, dtype=torch.float64)}), "torch.float64 (16,), expected"),
    "not finite": (lambda p: changed(p, {BIAS: torch.full((16,), torch.nan)}), "not finite"),
    "one too many": (lambda p: changed(p, {"weights.more": torch.zeros(1)}), "'weights.more' is not known"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_what_is_no_checkpoint_is_refused_in_one_line(good: Path, kind: str) -> None:
    damage, words = HOSTILE[kind]
    damage(good)
    with pytest.raises(TrainError) as caught:
        load_checkpoint(good)
    assert words in str(caught.value)
    assert str(good) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == 2


def test_a_huge_file_is_refused_before_it_is_read(good: Path) -> None:
    os.truncate(good, checkpoint._MAX_FILE_BYTES + 1)
    with pytest.raises(TrainError, match="bytes; at most"):
        load_checkpoint(good)


def test_a_config_that_asks_for_a_huge_network_is_refused(good: Path, tiny: TrainConfig) -> None:
    fields = tiny.model_dump(mode="json")
    fields["layers"] = {"width": 2048, "depth": 8, "channels": 128, "hidden_channels": 256, "side": 32}
    changed(good, config=json.dumps(fields))
    with pytest.raises(TrainError, match="weights; at most 50,000,000"):
        load_checkpoint(good)


def test_the_count_of_weights_is_the_network_s(tiny: TrainConfig) -> None:
    assert tiny.weight_count() == sum(p.numel() for p in tiny.build_network().parameters())


def test_a_write_that_fails_leaves_the_old_file(good: Path, tiny: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    before = good.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "no space left", str(good))

    monkeypatch.setattr(checkpoint.os, "fsync", full)
    with pytest.raises(OSError, match="no space"):
        save_checkpoint(good, tiny, new_state(tiny))
    assert good.read_bytes() == before
    assert list(good.parent.iterdir()) == [good]


def test_a_generator_s_report_must_be_a_table(tmp_path: Path, tiny: TrainConfig) -> None:
    path = tmp_path / "generator.safetensors"
    save_generator(path, tiny, new_state(tiny).weights, {"mse": 0.5})
    assert load_weights(path)[2] == {"mse": 0.5}
    changed(path, report="[1]")
    with pytest.raises(TrainError, match="report is not a table"):
        load_weights(path)


def test_captures_must_fit_the_generator(tmp_path: Path, tiny: TrainConfig) -> None:
    path = tmp_path / "captures.safetensors"
    inputs = {"depth_mm": torch.tensor([11.0, 15, 20]), "tilt_deg": torch.tensor([0.0, 5, 10])}
    images = torch.rand(3, 32, 32)
    save_captures(path, inputs, images, 0.8, "centred", "loopback rig")
    captures, source = load_captures(path, tiny)
    assert source == "loopback rig"
    assert captures.inputs.tolist() == [[11, 0], [15, 5], [20, 10]]
    torch.testing.assert_close(captures.images, images, atol=0.5 / 255 + 1e-6, rtol=0)
    for change, words in (
        ({"px_mm": 0.2}, "px_mm is 0.2"),
        ({"placement": "zero-touch"}, "placement is 'zero-touch'"),
        ({"images": torch.rand(3, 16, 16)}, "images must be"),
        ({"inputs": inputs | {"depth_mm": torch.tensor([11.0, 15, 21])}}, "depth_mm = 21 is outside"),
        ({"inputs": inputs | {"speed": torch.zeros(3)}}, "'speed' is not an input"),
        ({"inputs": {"depth_mm": inputs["depth_mm"]}}, "tilt_deg must be 3"),
    ):
        fields = {"inputs": inputs, "images": images, "px_mm": 0.8, "placement": "centred", "source": "x"} | change
        save_captures(path, **fields)
        with pytest.raises(TrainError, match=words):
            load_captures(path, tiny)


def test_repeats_of_a_condition_are_held_out_together(tmp_path: Path, tiny: TrainConfig) -> None:
    depths = torch.arange(11.0, 17.0).repeat_interleave(4)
    inputs = {"depth_mm": depths, "tilt_deg": torch.zeros(24)}
    path = tmp_path / "captures.safetensors"
    save_captures(path, inputs, torch.rand(24, 32, 32), 0.8, "centred", "loopback rig")
    captures, _ = load_captures(path, tiny)
    for seed in range(5):
        kept, held = split(captures, seed, 0.3)
        assert len(held) == 8
        assert len(kept) == 16
        assert not set(held.inputs[:, 0].tolist()) & set(kept.inputs[:, 0].tolist())


def test_captures_of_one_condition_are_refused(tmp_path: Path, tiny: TrainConfig) -> None:
    inputs = {"depth_mm": torch.full((4,), 13.0), "tilt_deg": torch.zeros(4)}
    path = tmp_path / "captures.safetensors"
    save_captures(path, inputs, torch.rand(4, 32, 32), 0.8, "centred", "loopback rig")
    with pytest.raises(TrainError, match="at least two conditions"):
        load_captures(path, tiny)
