"""`brushloop train`: Algorithm 1, what a folder holds, how captures are divided, and what happens after a cut."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.model.generator import TrainError
from brushloop.model.generator import train as training
from brushloop.model.generator.config import TrainConfig, checked, load_config
from brushloop.model.generator.data import Images, split
from brushloop.model.generator.network import Generator
from brushloop.model.generator.stroke import read_generator
from brushloop.model.generator.train import new_network, run_training

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


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


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
    ran = CliRunner().invoke(app, ["train", "--config", str(toml), "--out", str(toml.parent / "g")])
    assert ran.exit_code == 0, ran.exception
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
    assert "It has seen no real ink" in card
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
    with FileLock(tmp_path / ".lock"), pytest.raises(TrainError, match="another training writes here"):
        run_training(tiny, tmp_path, pytest.fail)
    (tmp_path / "checkpoint.pt").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(TrainError, match=r"is not a checkpoint of this training: [^\n]*$"):
        run_training(tiny, tmp_path, pytest.fail)


@pytest.mark.parametrize(("bias", "words"), [(-100.0, "draws 0.00% ink where .* ink_weight"), (100.0, "draws 100"),
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
    error = CliRunner().invoke(app, ["train", *arguments]).exception
    assert words in str(error)
    assert "\n" not in str(error)
    assert getattr(error, "exit_code", None) == 2
    with pytest.raises(TrainError, match=r"train.toml: steps: Input should be greater than or equal to 1"):
        checked("train.toml", {"steps": 0})
