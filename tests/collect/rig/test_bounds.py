"""Absurd numbers in a configuration are refused in one line, before anything is computed from them."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.calibrate.board.register import read_rig
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.drivers.sim.brush.spec import SimFileError, load_brush
from brushloop.model.generator import TrainError
from brushloop.model.generator.config import load_config
from tests.collect.rig.test_config import RIG

DIGITS = "9" * 10_000
READERS = [
    (load_protocol, ConfigError),
    (load_rig, ConfigError),
    (lambda path: load_brush(path, 1), SimFileError),
    (load_config, TrainError),
    (read_rig, CalibrationError),
]


@pytest.mark.parametrize(("read", "refused"), READERS, ids=["protocol", "rig", "brush", "training", "board of a rig"])
def test_a_number_of_ten_thousand_digits_is_refused(tmp_path: Path, read: object, refused: type[Exception]) -> None:
    assert callable(read)
    path = tmp_path / "a.toml"
    path.write_text(f"seed = {DIGITS}\n")
    with pytest.raises(refused, match=r"a\.toml: .*TOML"):
        read(path)


@pytest.fixture
def rig_toml(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


def test_patches_too_small_to_be_counted_are_refused(rig_toml: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRUSHLOOP_PAPER__CELL_MM", "[1e-5, 1e-5]")
    with pytest.raises(ConfigError, match=r"PAPER__CELL_MM: paper\.cell_mm\.0: .* greater than or equal to 2"):
        load_rig(rig_toml)


def test_a_variable_nested_without_end_is_refused(rig_toml: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BRUSHLOOP_PAPER", "[" * 100_000)
    with pytest.raises(ConfigError, match=r"environment variable BRUSHLOOP_PAPER: paper: is not JSON"):
        load_rig(rig_toml)
