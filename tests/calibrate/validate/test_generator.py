"""A trained generator among the models, and captured presses as `brushloop train tune` reads them, end to end."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.validate.tables import NORMAL, load_report
from brushloop.calibrate.validate.tuning import align_captures
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.model.generator.data import load_captures
from brushloop.model.generator.stroke import load_generator, read_generator
from brushloop.sessions.records import Source

# One word a line, as the file's owner would write it.
TRAINING = """
steps = 250
training_images = 400
validation_images = 16
batch = 32
validate_every = 125
picture_every = 250
learning_rate = 0.01
[target]
px_mm = 1.0
size_px = 32
placement = "PLACEMENT"
[layers]
width = 32
channels = 4
side = 8
"""


@pytest.fixture(autouse=True)
def one_thread() -> object:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def invoke(*arguments: str | Path) -> str:
    ran = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert ran.exit_code == 0, (ran.output, ran.exception)
    return " ".join(ran.output.split())


@pytest.fixture(scope="module")
def generator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("generator")
    (folder / "train.toml").write_text(TRAINING.replace("PLACEMENT", "centred"))
    invoke("train", "--config", folder / "train.toml", "--out", folder / "made")
    return folder / "made" / "generator.safetensors"


def test_a_generator_is_scored_beside_what_it_was_trained_on(session: Path, generator: Path, tmp_path: Path) -> None:
    training = generator.parent
    given = ("--generator", generator, "--curves", f"CCD-BSMG={training}", "--no-held-out")
    invoke("validate", session, "--out", tmp_path, *given)
    report = load_report(tmp_path / "report.json")
    drawn, exact = (report.stat(name, NORMAL) for name in ("ccd-bsmg", "ccd-bsm"))
    assert drawn is not None
    assert exact is not None
    assert drawn.csim.n == exact.csim.n == 10
    assert drawn.csim.avg == pytest.approx(exact.csim.avg, abs=6.0)
    rival = report.model("ccd-bsmg")
    assert rival is not None
    assert rival.basis == "trained on exact images of CCD-BSM"
    assert len(rival.sha256) == 64


@pytest.mark.parametrize("placement", ["centred", "zero-touch"])
def test_captures_go_through_the_file_into_a_tuning(
    session: Path, generator: Path, tmp_path: Path, placement: str
) -> None:
    if placement == "zero-touch":
        (tmp_path / "train.toml").write_text(
            TRAINING.replace("PLACEMENT", placement)
            .replace("steps = 250", "steps = 60")
            .replace("px_mm = 1.0", "px_mm = 1.4")
        )
        invoke("train", "--config", tmp_path / "train.toml", "--out", tmp_path / "made")
        generator = tmp_path / "made" / "generator.safetensors"
    captures = tmp_path / "captures.safetensors"
    said = invoke("validate", "captures", session, "--generator", generator, "--out", captures)
    assert "left out: blank" in said
    assert "10 presses (imported photographs)" in said

    kept, source = load_captures(captures, read_generator(generator).config.target)
    inputs, truth = kept.pick(np.arange(len(kept)))
    assert source == "imported photographs"
    assert truth.shape == (10, 32, 32)
    assert inputs.tolist()[:2] == [[11.0, 0.0], [11.0, 10.0]]
    # The ink of a deeper press is more; none is cut off, and it lies where the generator puts it.
    area = truth.sum(axis=(1, 2))
    assert area[2] > 1.5 * area[0]
    assert truth[:, 0].max() == truth[:, -1].max() == 0.0
    middle = (truth.sum(axis=1) * np.arange(32)).sum(axis=1) / area
    assert np.abs(middle - (16 if placement == "centred" else 18)).max() < 4.0

    tuned = tmp_path / "tuned"
    invoke("train", "tune", generator, captures, "--out", tuned, "--steps", "100", "--held-out", "0.25")
    made = load_generator(tuned / "generator.safetensors")
    assert made.fitted
    before, after = (
        float(np.square(load_generator(path).file.images(inputs) - truth).mean())
        for path in (generator, tuned / "generator.safetensors")
    )
    assert after < 0.8 * before


def test_captures_of_a_described_brush_keep_its_remark() -> None:
    brush = "soft (twin of monday, simulated)"
    header = SimpleNamespace(source=Source.LOOPBACK, brush=brush, brush_radius_mm=None, brush_length_mm=None)
    empty = SimpleNamespace(header=header, recording=SimpleNamespace(captures=lambda: iter(())))
    found = align_captures([cast(OpenSession, empty)], SHIPPED_GENERATOR)
    assert found.source == "loopback rig, brush twin of monday, simulated"
