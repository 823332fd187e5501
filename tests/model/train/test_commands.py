"""`brushloop train` and `tune` as a user runs them, and what a generator then is to the rest."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.model.train.checkpoint import load_generator
from brushloop.model.train.cli import app
from brushloop.model.train.data import save_captures
from brushloop.model.train.errors import TrainError
from brushloop.model.train.report import Samples, load_samples, save_samples
from tests.browser import BROWSER, content_widths_px


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory, write_tiny: Callable[[Path], Path]) -> Path:
    """A generator that is trained once for all tests here."""
    folder = tmp_path_factory.mktemp("once")
    ran = CliRunner().invoke(app, ["--config", str(write_tiny(folder)), "--out", str(folder / "g")])
    assert ran.exit_code == 0, ran.exception
    return folder / "g" / "generator.safetensors"


def test_fine_tuning_on_captures_is_marked_as_such(once: Path, tmp_path: Path) -> None:
    before = load_generator(once)
    assert not before.fitted
    inputs = torch.stack((torch.linspace(11, 20, 20), torch.linspace(0, 10, 20)), dim=-1)
    images = before.target.images(inputs).roll(2, dims=1)  # a brush that marks the paper two pixels lower
    captures = tmp_path / "captures.safetensors"
    named = {"depth_mm": inputs[:, 0], "tilt_deg": inputs[:, 1]}
    save_captures(captures, named, images, 0.8, "centred", "loopback rig")
    command = ["tune", str(once), str(captures), "--out", str(tmp_path / "t"), "--steps", "60"]
    ran = CliRunner().invoke(app, [*command, "--learning-rate", "0.01"])
    assert ran.exit_code == 0, ran.exception
    after = load_generator(tmp_path / "t" / "generator.safetensors")
    assert after.fitted
    assert "tuned on captured strokes" in after.definition
    assert "loopback rig" in (tmp_path / "t" / "generator.md").read_text()
    with torch.no_grad():
        old, new = (((m.network(inputs) - images) ** 2).mean().item() for m in (before, after))
    assert new < 0.7 * old
    again = CliRunner().invoke(app, [*command, "--learning-rate", "0.02"])
    assert "learning_rate: 0.01 -> 0.02" in str(again.exception)


def test_the_page_draws_held_out_strokes_and_says_that_there_is_no_ink(once: Path, tmp_path: Path) -> None:
    """The same command again trains nothing, and writes the page again."""
    words = ["train", "--config", str(once.parents[1] / "train.toml"), "--out", str(once.parent)]
    ran = CliRunner().invoke(brushloop.__main__.app, words)
    assert ran.exit_code == 0, ran.exception
    path = once.with_name("training.html")
    assert ran.output.splitlines()[-1] == f"Page: {path}"
    page = path.read_text(encoding="utf-8")
    assert page.count('alt="network: depth_mm ') == 12
    assert '<span class="source">exact images of a stroke model</span>' in page
    assert "was trained for 30 steps: all steps done" in page
    assert re.findall(r"(?:src|href)=\"(?!data:|#)", page) == []
    assert len(page.encode()) < 3 * 1024 * 1024
    if BROWSER is not None:
        sizes, errors = content_widths_px({"train": page}, (390, 800, 1200, 1600), tmp_path)
        assert errors == []
        assert all(taken <= width for (_, width), taken in sizes.items()), sizes


def test_samples_that_are_not_of_this_generator_are_refused(tmp_path: Path) -> None:
    images = torch.zeros((3, 8, 8), dtype=torch.uint8)
    save_samples(tmp_path, Samples(torch.zeros((3, 2)), images, images.clone()))
    assert len(load_samples(tmp_path, 2).drawn) == 3
    with pytest.raises(TrainError, match="inputs is not 3 x 8 floating-point numbers"):
        load_samples(tmp_path, 8)
    save_samples(tmp_path, Samples(torch.zeros((3, 2)), images, images[:, :4].clone()))
    with pytest.raises(TrainError, match="targets and drawn are not uint8 images of one size"):
        load_samples(tmp_path, 2)


def test_help_loads_nothing_heavy() -> None:
    heavy = {"torch", "numpy", "pydantic", "rich.progress"}
    code = f"import sys, brushloop.model.train.cli; assert not {heavy} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--target", "cube"], "cube: no such target; known: press, anchored, all, qbc, bezier"),
        (["--config", "no.toml"], "no.toml: No such file"),
        (["--steps", "0"], "steps: Input should be greater than or equal to 1"),
        (["--device", "tpu"], "device: Input should be 'cpu' or 'cuda'"),
        (["tune", "no.safetensors", "captures.safetensors"], "no.safetensors: no such file"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], words: str, tmp_path: Path) -> None:
    error = CliRunner().invoke(app, arguments).exception
    assert words in str(error)
    assert "\n" not in str(error)
    assert getattr(error, "exit_code", None) == 2
