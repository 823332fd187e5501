"""`brushloop calibrate SESSION`: each bad view of the board is a stated error or a stated flag, and nothing is left."""

from __future__ import annotations

import errno
import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World
from tests.calibrate.simulated_rigs import board_of
from tests.command import brushloop

if TYPE_CHECKING:
    from conftest import Photographed

SPEC = board_of(Table())
SHEET_MM = Table().sheet_mm


@pytest.fixture(scope="module")
def board() -> np.ndarray:
    config = SimConfig(view=View(width_px=1024, height_px=768, px_per_mm=3.125))
    return Scene(World(config)).render(0, brush_pose(*config.home_mm))


def half(image: np.ndarray, share: float) -> np.ndarray:
    hidden = image.copy()
    hidden[:, : round(share * image.shape[1])] = 70
    return hidden


def test_a_session_without_a_usable_board_is_refused(
    photographed: Photographed, tmp_path: Path, board: np.ndarray
) -> None:
    session = photographed(tmp_path / "s", SPEC, [np.ascontiguousarray(board[:, ::-1])])
    ran = CliRunner().invoke(app, ["calibrate", str(session)])
    assert isinstance(ran.exception, CalibrationError), ran.output
    assert ran.exception.exit_code == 2
    assert "is mirrored" in str(ran.exception)
    assert not (session / "calibration").exists()


def test_what_can_be_used_with_care_is_flagged_in_the_artefact(
    photographed: Photographed, tmp_path: Path, board: np.ndarray
) -> None:
    session = photographed(tmp_path / "s", SPEC, [half(board, 0.6)], sheet_mm=SHEET_MM)
    ran = CliRunner().invoke(app, ["calibrate", str(session)])
    assert ran.exit_code == 0, ran.output
    assert "the board is partly hidden" in " ".join(ran.output.split())
    path = current(session)
    assert path is not None
    assert any("partly hidden" in flag for flag in load_artefact(path, Calibration).flags)


def test_a_full_disk_is_one_line_and_leaves_nothing_half_written(
    photographed: Photographed, tmp_path: Path, board: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = photographed(tmp_path / "s", SPEC, [board], sheet_mm=SHEET_MM)
    write_bytes = Path.write_bytes

    def half_of_it(path: Path, data: bytes) -> int:
        write_bytes(path, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half_of_it)
    ran = brushloop("calibrate", session)
    assert (ran.returncode, ran.stdout) == (4, "")
    assert re.fullmatch(r"brushloop: .*/calibration/\w+\.json: No space left on device\n", ran.stderr)
    assert list((session / "calibration").iterdir()) == []
