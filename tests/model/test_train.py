"""`brushloop train` and `tune`: Algorithm 1, what a folder holds, captures, and what happens after a cut."""

from __future__ import annotations

import io
import math
import multiprocessing
import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filelock import FileLock
from rich.console import Console  # noqa: TID251
from rich.progress import Progress
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.model.generator import TrainError, TrainingStopped
from brushloop.model.generator import train as training
from brushloop.model.generator.card import read_curves
from brushloop.model.generator.cli import Bar, app
from brushloop.model.generator.config import TrainConfig, checked, load_config
from brushloop.model.generator.data import load_captures, save_captures, split
from brushloop.model.generator.stroke import load_generator
from brushloop.model.generator.train import Generator, converged, new_network, run_training

TINY: dict[str, Any] = {
    "target": {"px_mm": 0.8, "size_px": 32},
    "layers": {"width": 16, "channels": 4, "side": 8},
    "training_images": 96,
    "validation_images": 16,
    "batch": 16,
    "steps": 30,
    "validate_every": 10,
    "checkpoint_every": 10,
    "picture_every": 15,
}


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def tiny(**changes: Any) -> TrainConfig:
    """A training so small that it takes a second."""
    return checked("tiny", TINY | changes)


def write_toml(folder: Path, **changes: int) -> Path:
    numbers = {name: value for name, value in (TINY | changes).items() if isinstance(value, int)}
    text = "".join(f"{name} = {value}\n" for name, value in numbers.items())
    path = folder / "train.toml"
    path.write_text(f"{text}[target]\npx_mm = 0.8\nsize_px = 32\n[layers]\nwidth = 16\nchannels = 4\nside = 8\n")
    return path


class Notes(list[float]):
    """The losses that were reported."""

    def __call__(self, step: int, loss: float, held_out: float) -> None:
        self.append(loss)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a training that nobody disturbed."""
    folder = tmp_path_factory.mktemp("finished")
    ran = CliRunner().invoke(app, ["--config", str(write_toml(folder)), "--out", str(folder / "g")])
    assert ran.exit_code == 0, ran.exception
    return folder / "g"


def test_it_learns_and_shows_pictures_every_m_steps(tmp_path: Path) -> None:
    notes = Notes()
    run_training(tiny(steps=120, validate_every=40, learning_rate=0.02), tmp_path, notes)
    losses, validations = read_curves(tmp_path)
    assert losses.tolist() == pytest.approx(notes)
    assert losses[-1] < 0.2 * losses[0]
    assert validations[:, 0].tolist() == [40, 80, 120]
    assert validations[-1, 2] > 0.8
    assert len(list((tmp_path / "pictures").iterdir())) == 8


def test_the_folder_holds_all_that_the_algorithm_puts_out(finished: Path) -> None:
    left = {str(path.relative_to(finished)) for path in finished.rglob("*") if path.is_file()} - {".lock"}
    files = {"checkpoint.pt", "generator.safetensors", "generator.md", "samples.safetensors", "loss.csv"}
    assert left == files | {"validation.csv"} | {f"pictures/step-{step:07d}.png" for step in (15, 30)}
    assert len((finished / "loss.csv").read_text().splitlines()) == 31
    card = (finished / "generator.md").read_text()
    assert "H from 11 to 20 mm, alpha from 0 to 10 deg" in card
    assert "It has seen no real ink" in card
    assert "30 steps of 16, seed 0, all steps done" in card


KILLED = """
from pathlib import Path
from brushloop.model.generator.config import load_config
from brushloop.model.generator.train import run_training

run_training(load_config(Path(toml)), Path(out), lambda step, *_: steps.send(step))
"""


def test_killed_at_random_and_resumed_it_ends_like_one_that_was_not(tmp_path: Path, finished: Path) -> None:
    toml = write_toml(tmp_path, checkpoint_every=3)
    last = random.randint(1, 28)
    context = multiprocessing.get_context("spawn")
    steps, tell = context.Pipe(duplex=False)
    child = context.Process(target=exec, args=(KILLED, {"toml": str(toml), "out": str(tmp_path), "steps": tell}))
    child.start()
    while steps.recv() != last:
        pass
    child.kill()
    child.join()
    assert not (tmp_path / "generator.safetensors").exists()
    run_training(load_config(toml), tmp_path, Notes())
    resumed, unbroken = read_curves(tmp_path), read_curves(finished)
    for ours, whole in zip(resumed, unbroken, strict=True):
        np.testing.assert_allclose(ours, whole, rtol=1e-4, err_msg=f"killed at step {last}")


def test_a_finished_training_is_not_done_again_and_another_one_is_refused(finished: Path, tmp_path: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in finished.glob("*.*") if path.name != ".lock"}
    run_training(tiny(), finished, Notes())
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with pytest.raises(TrainError, match="another configuration: steps: 30 -> 40; use a new folder"):
        run_training(tiny(steps=40), finished, Notes())
    with FileLock(tmp_path / ".lock"), pytest.raises(TrainError, match="another training writes here"):
        run_training(tiny(), tmp_path, Notes())
    (tmp_path / "checkpoint.pt").write_bytes(b"PK\x03\x04 cut")
    with pytest.raises(TrainError, match=r"is not a checkpoint of this training: [^\n]*$"):
        run_training(tiny(), tmp_path, Notes())


def test_asked_to_stop_it_keeps_the_last_step(tmp_path: Path) -> None:
    notes = Notes()
    with pytest.raises(TrainingStopped, match=r"step 4: .* resumes here"):
        run_training(tiny(), tmp_path, notes, lambda: len(notes) == 3)
    run_training(tiny(), tmp_path, notes)
    assert len(notes) == 30


@pytest.mark.parametrize(("bias", "words"), [(-100.0, "draws 0.00% ink where .* ink_weight"), (100.0, "draws 100"),
                                             (math.nan, "step 1: the loss is no longer a number")])  # fmt: skip
def test_blank_output_ends_the_training_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bias: float, words: str
) -> None:
    def biased(config: TrainConfig) -> Generator:
        network = new_network(config)
        torch.nn.init.constant_(network.convolution[0].bias, bias)
        return network

    monkeypatch.setattr(training, "new_network", biased)
    with pytest.raises(TrainingStopped, match=words) as caught:
        run_training(tiny(learning_rate=1e-9), tmp_path, Notes())
    assert caught.value.exit_code == 4


def test_it_stops_when_converged(tmp_path: Path) -> None:
    notes = Notes()
    run_training(tiny(target_mse=0.9), tmp_path, notes)
    assert len(notes) == 10
    patient = tiny(patience=2)
    assert converged(patient, [1.0, 0.5, 0.499, 0.498])
    assert not converged(patient, [1.0, 0.5, 0.499])
    assert not converged(patient, [1.0, 0.5, 0.499, 0.498, 0.4])


def test_captures_must_fit_the_generator(tmp_path: Path) -> None:
    path, target = tmp_path / "captures.safetensors", tiny().target
    inputs = {"depth_mm": [11.0, 15.0, 20.0], "tilt_deg": [0.0, 5.0, 10.0]}
    images = np.random.default_rng(0).random((3, 32, 32), np.float32)
    good: dict[str, Any] = {"inputs": inputs, "images": images, "px_mm": 0.8, "placement": "centred", "source": "rig"}
    save_captures(path, **good)
    captures, source = load_captures(path, target)
    assert source == "rig"
    assert captures.inputs.tolist() == [[11, 0], [15, 5], [20, 10]]
    np.testing.assert_allclose(captures.pick(np.arange(3))[1], images, atol=0.5 / 255 + 1e-6, rtol=0)
    for change, words in (
        ({"px_mm": 0.2}, "px_mm is '0.2', expected '0.8'"),
        ({"placement": "zero-touch"}, "placement is 'zero-touch'"),
        ({"images": images[:, :16, :16]}, "images must be"),
        ({"inputs": inputs | {"depth_mm": [11.0, 15, 21]}}, "depth_mm = 21 is outside"),
        ({"inputs": inputs | {"speed": [0.0, 0.0, 0.0]}}, "'speed' is not an input"),
        ({"inputs": {"depth_mm": inputs["depth_mm"]}}, "tilt_deg must be 3"),
        ({"inputs": {"depth_mm": [13.0] * 3, "tilt_deg": [0.0] * 3}}, "at least two conditions"),
    ):
        save_captures(path, **good | change)
        with pytest.raises(TrainError, match=words):
            load_captures(path, target)


def test_repeats_of_a_condition_are_held_out_together(tmp_path: Path) -> None:
    inputs = {"depth_mm": np.repeat(np.arange(11.0, 17.0), 4), "tilt_deg": np.zeros(24)}
    path = tmp_path / "captures.safetensors"
    save_captures(path, inputs, np.zeros((24, 32, 32), np.float32), 0.8, "centred", "loopback rig")
    captures, _ = load_captures(path, tiny().target)
    for seed in range(5):
        kept, held = split(captures, seed, 0.3)
        assert (len(kept), len(held)) == (16, 8)
        assert not set(held.inputs[:, 0].tolist()) & set(kept.inputs[:, 0].tolist())


def test_fine_tuning_on_captures_is_marked_as_such(finished: Path, tmp_path: Path) -> None:
    path = finished / "generator.safetensors"
    before = load_generator(path)
    assert not before.fitted
    inputs = np.column_stack((np.linspace(11, 20, 20), np.linspace(0, 10, 20)))
    images = np.roll(before.target.images(inputs), 2, axis=1)  # a brush that marks the paper two pixels lower
    captures = tmp_path / "captures.safetensors"
    named = {"depth_mm": inputs[:, 0], "tilt_deg": inputs[:, 1]}
    save_captures(captures, named, images, 0.8, "centred", "loopback rig")
    command = ["tune", str(path), str(captures), "--out", str(tmp_path / "t"), "--steps", "60"]
    ran = CliRunner().invoke(app, [*command, "--learning-rate", "0.01"])
    assert ran.exit_code == 0, ran.exception
    after = load_generator(tmp_path / "t" / "generator.safetensors")
    assert after.fitted
    assert "tuned on captured strokes" in after.definition
    assert "loopback rig" in (tmp_path / "t" / "generator.md").read_text()
    old, new = (np.square(model.file.images(inputs) - images).mean() for model in (before, after))
    assert new < 0.7 * old
    again = CliRunner().invoke(app, [*command, "--learning-rate", "0.02"])
    assert "learning_rate: 0.01 -> 0.02" in str(again.exception)


def test_the_page_draws_held_out_strokes_and_says_that_there_is_no_ink(finished: Path) -> None:
    """The same command again trains nothing, and writes the page again."""
    words = ["train", "--config", str(finished.parent / "train.toml"), "--out", str(finished)]
    ran = CliRunner().invoke(brushloop.__main__.app, words)
    assert ran.exit_code == 0, ran.exception
    path = finished / "training.html"
    assert ran.output.splitlines()[-1] == f"Page: {path}"
    page = path.read_text(encoding="utf-8")
    path.unlink()
    assert page.count('alt="network: depth_mm ') == 12
    assert '<span class="source">exact images of a stroke model</span>' in page
    assert "was trained for 30 steps: all steps done" in page
    assert re.findall(r"(?:src|href)=\"(?!data:|#)", page) == []


def test_without_a_terminal_each_tenth_is_a_line_with_the_time_that_is_left() -> None:
    said, now_s = io.StringIO(), iter(range(1000))
    progress = Progress(console=Console(file=said, width=120), get_time=lambda: float(next(now_s)), disable=True)
    bar = Bar(progress, 20)
    for step in range(1, 21):
        bar(step, 0.5 / step, math.nan)
    lines = said.getvalue().splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("training: 2 of 20 steps")
    assert "s left" in lines[4]
    assert lines[-1] == "training: 20 of 20 steps, MSE 2.5e-02"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--target", "cube"], "cube: no such target; known: press, anchored"),
        (["--config", "no.toml"], "no.toml: No such file"),
        (["--steps", "0"], "steps: Input should be greater than or equal to 1"),
        (["--device", "tpu"], "device: Input should be 'cpu' or 'cuda'"),
        (["tune", "no.safetensors", "captures.safetensors"], "no.safetensors: no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], words: str) -> None:
    error = CliRunner().invoke(app, arguments).exception
    assert words in str(error)
    assert "\n" not in str(error)
    assert getattr(error, "exit_code", None) == 2
