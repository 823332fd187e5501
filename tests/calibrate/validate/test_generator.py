"""A trained generator among the models, and the same tuned on the presses of a session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.compare import NORMAL
from brushloop.calibrate.session import open_session
from brushloop.calibrate.training import captures_of
from brushloop.calibrate.validate.tables import Report
from brushloop.model.generator import SHIPPED_GENERATOR
from brushloop.model.generator.stroke import load_generator
from brushloop.sessions.records import Source
from tests.calibrate.conftest import CONDITIONS
from tests.command import refused, said
from tests.photographed import imported_presses

TRAINING = """
steps = 120
training_images = 200
validation_images = 16
batch = 32
validate_every = 60
picture_every = 120
learning_rate = 0.01
[target]
px_mm = 1.0
size_px = 32
placement = "centred"
[layers]
width = 32
channels = 4
side = 8
"""


@pytest.fixture(scope="module")
def generator(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("generator")
    (folder / "train.toml").write_text(TRAINING)
    said("train", "--config", folder / "train.toml", "--out", folder / "made")
    return folder / "made" / "generator.safetensors"


def test_a_generator_is_scored_beside_what_it_was_trained_on(session: Path, generator: Path, tmp_path: Path) -> None:
    said("validate", session, "--out", tmp_path, "--generator", generator, "--no-held-out", left_out=True)
    report = Report.read(tmp_path)
    drawn, exact = (report.stat(name, NORMAL) for name in ("ccd-bsmg", "ccd-bsm"))
    assert drawn is not None
    assert exact is not None
    assert drawn.csim.n == exact.csim.n == 10
    assert drawn.csim.avg == pytest.approx(exact.csim.avg, abs=6.0)
    rival = report.model("ccd-bsmg")
    assert rival is not None
    assert rival.basis == "trained on exact images of CCD-BSM"
    assert len(rival.sha256) == 64


def test_captures_lie_where_the_generator_puts_its_strokes(session: Path, generator: Path) -> None:
    for path, middle_px, within_px in ((generator, 16, 4.0), (SHIPPED_GENERATOR, 65, 16.0)):
        images = captures_of([open_session(session)], path)[0].images
        assert images.inputs.tolist()[:2] == [[11.0, 0.0], [11.0, 10.0]]
        _, truth = images.pick(np.arange(len(images)))
        assert len(truth) == 10
        # The ink of a deeper press is more, and none is cut off.
        area = truth.sum(axis=(1, 2))
        assert area[2] > 1.5 * area[0]
        assert truth[:, 0].max() == truth[:, -1].max() == 0.0
        middle = (truth.sum(axis=1) * np.arange(truth.shape[2])).sum(axis=1) / area
        assert np.abs(middle - middle_px).max() < within_px


def test_a_generator_is_tuned_on_the_presses_of_a_session(session: Path, generator: Path, tmp_path: Path) -> None:
    images = captures_of([open_session(session)], generator)[0].images
    inputs, truth = images.pick(np.arange(len(images)))
    command = ("train", "tune", generator, session, "--out", tmp_path / "tuned", "--steps", "100")
    output = said(*command, "--learning-rate", "0.001", left_out=True)
    assert "left out: blank" in output
    assert "10 presses (imported photographs)" in output
    tuned = load_generator(tmp_path / "tuned" / "generator.safetensors")
    assert tuned.fitted
    assert "tuned on captured strokes" in tuned.definition
    for name in ("generator.md", "training.html"):
        assert "captures of imported photographs" in (tmp_path / "tuned" / name).read_text()
    before, after = (
        float(np.square(model.file.images(inputs) - truth).mean()) for model in (load_generator(generator), tuned)
    )
    assert after < 0.8 * before
    assert "learning_rate: 0.001 -> 0.02" in refused(*command, "--learning-rate", "0.02")


def test_presses_of_a_single_condition_are_refused_and_a_described_brush_keeps_its_remark(
    generator: Path, tmp_path: Path
) -> None:
    pressed = open_session(imported_presses(tmp_path, CONDITIONS))
    twin = {"source": Source.LOOPBACK, "brush": "soft (twin of monday, simulated)"}
    pressed.recording.header = pressed.header.model_copy(update=twin)
    assert captures_of([pressed], generator)[0].source == "loopback rig, brush twin of monday, simulated"
    single = imported_presses(tmp_path, CONDITIONS[:1] * 2, name="single")
    assert "1 conditions are left, at least 2 are needed" in refused("train", "tune", generator, single)
