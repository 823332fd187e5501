"""`brushloop calibrate` with show, diff and apply: a bad board is said, another session's calibration needs force."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from brushloop.__main__ import app
from brushloop.calibrate.artefact import HASH_CHARS, current, load_artefact, put_to_use
from brushloop.calibrate.calibrated import CalibrateRequest, calibrate_session
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.session import calibration_of
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke
from tests.calibrate.given import CALIBRATION
from tests.calibrate.simulated_rigs import board_of
from tests.command import brushloop
from tests.photographed import imported_presses

if TYPE_CHECKING:
    from conftest import Photographed

VIEW = View(width_px=1024, height_px=768, px_per_mm=3.125)
SPEC, SHEET_MM = board_of(Table()), Table().sheet_mm
Pair = tuple[Path, Path, Path]


def sheet(view: View) -> np.ndarray:
    config = SimConfig(view=view)
    return Scene(World(config)).render(0, brush_pose(*config.home_mm))


@pytest.fixture(scope="module")
def board() -> np.ndarray:
    return sheet(VIEW)


@pytest.fixture(scope="module")
def sessions(
    tmp_path_factory: pytest.TempPathFactory, photographed: Photographed, board: np.ndarray
) -> tuple[Path, Path]:
    """Two sessions with a stroke each; in the second the camera stands 5 mm further and nearer by half a percent.

    The first is calibrated.
    """
    root = tmp_path_factory.mktemp("sessions")
    stroke = Stroke(stroke_id="s", kind="press", still=0, anchor_mm=(100.0, 80.0))
    moved = sheet(dataclasses.replace(VIEW, centre_mm=(127.0, 86.0), px_per_mm=3.14))
    images = {"one": board, "other": moved}
    one, other = (photographed(root / name, SPEC, [image], [(stroke, image)]) for name, image in images.items())
    calibrate_session(CalibrateRequest(one))
    return one, other


@pytest.fixture
def pair(sessions: tuple[Path, Path], tmp_path: Path) -> Pair:
    """Copies of both sessions, and the calibration of the first."""
    one, other = (Path(shutil.copytree(folder, tmp_path / folder.name)) for folder in sessions)
    made = current(one)
    assert made is not None
    return one, other, made


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def used(session: Path) -> Calibration:
    recording = Recording(session)
    calibration = calibration_of(recording, next(recording.stroke_records()), recording.sha256, None)
    assert calibration is not None
    return calibration


def test_a_mirrored_board_is_refused_and_half_a_board_is_flagged(
    photographed: Photographed, tmp_path: Path, board: np.ndarray
) -> None:
    ran = run(mirrored := photographed(tmp_path / "mirrored", SPEC, [np.ascontiguousarray(board[:, ::-1])]))
    assert isinstance(ran.exception, CalibrationError), ran.output
    assert ran.exception.exit_code == 2
    assert "is mirrored" in str(ran.exception)
    assert not (mirrored / "calibration").exists()

    half = board.copy()
    half[:, :614] = 70
    for image, warned in ((half, True), (board, False)):
        session = photographed(tmp_path / f"warned-{warned}", SPEC, [image], sheet_mm=SHEET_MM)
        ran = run(session)
        assert ran.exit_code == 0, ran.output
        assert ("the board is partly hidden" in " ".join(ran.output.split())) is warned
        assert "lens: k1 fitted on the board" in ran.output
        path = current(session)
        assert path is not None
        assert any("partly hidden" in flag for flag in load_artefact(path, Calibration).flags) is warned


def test_an_import_has_its_own_scale(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    pressed = imported_presses(tmp_path / "photos", tmp_path / "s", [(11.0, 0.0)], (300, 480), (380, 150))
    for ran in (run(pressed), run("apply", CALIBRATION.save(tmp_path), pressed)):
        assert isinstance(ran.exception, CalibrationError)
        assert "is an import and has its own scale" in str(ran.exception)
    assert not (pressed / "calibration").exists()


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


def test_show_shows_every_value_of_an_artefact_or_of_the_one_a_session_uses(pair: Pair) -> None:
    one, other, made = pair
    for what in (made, one):
        ran = run("show", what)
        assert ran.exit_code == 0
        assert ran.output.splitlines()[0] == str(made)
        for line in ('source = "loopback rig"', 'lens.source = "k1 fitted on the board"', "board.square_mm = 12.0"):
            assert line in ran.output
    assert "is not calibrated" in str(run("show", other).exception)


def test_diff_says_what_changed_and_what_it_means_on_the_paper(pair: Pair) -> None:
    one, other, made = pair
    assert run("diff", one, made).output == "they are equal\n"
    calibrate_session(CalibrateRequest(other))
    printed = run("diff", one, other).output
    assert 'session_id: "one" -> "other"' in printed
    assert "preprocess" not in printed
    assert "pix2len differs by -0.4" in printed
    assert "their intervals lie apart" in printed
    words = next(line for line in printed.splitlines() if line.startswith("the same pixel lies"))
    assert float(words.split()[4]) == pytest.approx(5.0, abs=0.5)


def test_another_sessions_calibration_is_refused_unless_forced_and_then_labelled(pair: Pair) -> None:
    _, other, made = pair
    refused = run("apply", made, other)
    assert isinstance(refused.exception, CalibrationError)
    assert "belongs to another recording (one)" in str(refused.exception)
    assert not (other / "calibration").exists()

    shutil.copytree(made.parent, other / "calibration")
    with pytest.raises(CalibrationError, match=r"belongs to another recording \(one\): .*apply --force"):
        used(other)

    forced = run("apply", made, other, "--force")
    assert forced.exit_code == 0, forced.output
    assert f"warning: foreign calibration: {made.stem} of one (loopback rig), its board lies" in forced.output
    applied = used(other)
    assert applied.label in forced.output
    assert applied.foreign is not None
    assert applied.foreign.board_off_mm == pytest.approx(5.0, abs=0.5)
    assert applied.session_id == "other"
    assert applied.named.startswith(applied.digest + ", foreign calibration")
    assert run("show", other).output.splitlines()[1].startswith("foreign calibration")

    calibrate_session(CalibrateRequest(other))
    run("apply", made, other, "--force")
    assert used(other) == applied, "what was applied last is used"


def test_a_sessions_own_calibration_is_put_back_without_a_label(pair: Pair) -> None:
    one, _, made = pair
    put_to_use(load_artefact(made, Calibration).model_copy(update={"rms_px": 0.5}), one)
    assert used(one).rms_px == 0.5
    assert run("apply", made, one).output == f"{made}\n"
    assert (used(one).digest, used(one).label) == (made.stem, "")


def test_a_camera_of_another_size_cannot_be_forced(pair: Pair, tmp_path: Path, photographed: Photographed) -> None:
    small = photographed(tmp_path / "small", SPEC, [sheet(dataclasses.replace(VIEW, width_px=1000, height_px=750))])
    ran = run("apply", pair[2], small, "--force")
    assert "is 1000 x 750 px, the lens was calibrated at 1024 x 768 px" in str(ran.exception)
    assert not (small / "calibration").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no json", "is not an artefact: not JSON"),
        ("[" * 100_000, "is not an artefact: not JSON"),
        ('{"kind": "song"}', "is not an artefact of this software"),
        ('{"image_to_paper": 1}', "session_id: Field required"),
        (CALIBRATION.model_dump_json().replace('"schema_version":2', '"schema_version":3'), "schema_version: Input"),
    ],
    ids=["words", "deep", "another", "half", "of later"],
)
def test_what_is_no_artefact_is_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / f"{hashlib.sha256(text.encode()).hexdigest()[:HASH_CHARS]}.json"
    path.write_text(text)
    for ran in (run("show", path), run("diff", path, path)):
        assert isinstance(ran.exception, CalibrationError)
        assert message in str(ran.exception)
        assert "\n" not in str(ran.exception)
