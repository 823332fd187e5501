"""`camera check|drift|register|intrinsics`: what they say of a sound board, and how each bad photograph is refused."""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from brushloop.__main__ import app
from brushloop.calibrate.board.lens import Gray
from brushloop.calibrate.board.pix2len import apply
from brushloop.calibrate.board.spec import BoardSpec, charuco_board
from brushloop.calibrate.board.view import drift
from brushloop.calibrate.errors import CalibrationError
from tests.calibrate.given import kept_lens

if TYPE_CHECKING:
    from conftest import Photographed

SPEC = BoardSpec(squares=(9, 7), square_mm=20.0, marker_mm=15.0, dictionary="DICT_5X5_100", origin_mm=(0.0, 0.0))
BOARD = ("--charuco", "9x7", "--square-mm", "20", "--dictionary", "DICT_5X5_100")
FLAT = (*BOARD, "--origin-mm", "0", "0")
PX_PER_MM, EDGE_PX, HOUR_NS = 8.0, 60, 3_600_000_000_000
SLANT = np.array([[0.62, 0.02, 30.0], [-0.01, 0.62, 40.0], [1e-5, 2e-5, 1.0]])


@functools.cache
def board(shift_px: float = 0.0, seed: int = 0, scale: float = 1.0) -> Gray:
    """The board at about 5 px/mm, seen at a slant."""
    picture = charuco_board(SPEC, "test").generateImage((9 * 160, 7 * 160))
    picture = cv2.copyMakeBorder(picture, *[EDGE_PX] * 4, cv2.BORDER_CONSTANT, value=240)
    nearer = np.array([[scale, 0, 500.0 * (1 - scale) + shift_px], [0, scale, 400.0 * (1 - scale)], [0, 0, 1]])
    image = cv2.warpPerspective(picture, nearer @ SLANT, (1024, 800), flags=cv2.INTER_AREA, borderValue=120)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.9) + np.random.default_rng(seed).normal(0, 1.5, image.shape)
    seen = np.clip(noisy, 0, 235).astype(np.uint8)
    seen.flags.writeable = False
    return seen


def half_hidden() -> Gray:
    image = board().copy()
    image[:, 512:] = 200
    return image


BLANK = np.full((800, 1024), 220, np.uint8)
MIRRORED = np.ascontiguousarray(board()[:, ::-1])
SATURATED = np.where(board() > 110, 255, board()).astype(np.uint8)
FAR = cv2.resize(board(), None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)


def saved(path: Path, image: Gray) -> Path:
    cv2.imwrite(str(path), image)
    return path


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, ["camera", *map(str, arguments)])


def refused(ran: Result, message: str) -> None:
    assert isinstance(ran.exception, CalibrationError), ran.output
    assert ran.exception.exit_code == 2
    assert message in str(ran.exception)
    assert "\n" not in str(ran.exception)


def warnings_of(ran: Result) -> list[str]:
    return [line for line in ran.output.splitlines() if line.startswith("warning: ")]


@pytest.mark.parametrize(
    ("photograph", "message"),
    [
        (MIRRORED, "is mirrored"),
        (b"", "not a complete PNG or JPEG"),
        (b"\x89PNG\r\n\x1a\nabc", "not a complete PNG or JPEG"),
        (None, "no such file"),
    ],
    ids=["mirrored", "empty", "torn", "missing"],
)
def test_no_command_measures_by_a_photograph_that_shows_nothing(
    tmp_path: Path, photograph: Gray | bytes | None, message: str
) -> None:
    """The reasons that a photograph gives are those of `find_board` (test_intrinsics.py)."""
    path, out = tmp_path / "p.png", tmp_path / "out"
    if isinstance(photograph, bytes):
        path.write_bytes(photograph)
    elif photograph is not None:
        saved(path, photograph)
    refused(run("check", path, *BOARD), message)
    refused(run("intrinsics", path, *BOARD, "--out", out), message)
    refused(run("register", points(tmp_path), "--photograph", path, *FLAT, "--out", out), message)
    assert not out.exists()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (half_hidden(), "the board is partly hidden"),
        (SATURATED, "% of the pixels are saturated"),
        (FAR, "px/mm, at least"),
        (board(), ""),
    ],
    ids=["half hidden", "saturated", "far", "sound"],
)
def test_check_flags_what_can_be_used_with_care(tmp_path: Path, image: Gray, message: str) -> None:
    ran = run("check", saved(tmp_path / "p.png", image), *BOARD)
    assert ran.exit_code == (5 if message else 0), ran.output
    assert bool(warnings_of(ran)) is bool(message)
    assert message in " ".join(warnings_of(ran))
    assert ran.output.startswith("pix2len 0.")


def test_check_names_the_remedy_for_a_lens_that_bends_and_refuses_another_cameras(tmp_path: Path) -> None:
    columns, rows = np.meshgrid(np.arange(1024), np.arange(800))
    matrix = np.array([[1024.0, 0, 511.5], [0, 1024.0, 399.5], [0, 0, 1]])
    places = np.stack([columns, rows], -1).reshape(-1, 1, 2).astype(np.float64)
    places = cv2.undistortPoints(places, matrix, np.array([-0.1, 0, 0, 0]), P=matrix)
    bent = cv2.remap(board(), places.reshape(800, 1024, 2).astype(np.float32), np.empty(0), cv2.INTER_LINEAR)
    path = saved(tmp_path / "bent.png", np.asarray(bent, np.uint8))
    ran = run("check", path, *BOARD)
    assert ran.exit_code == 5
    assert "warning: the board is bent by" in ran.output
    assert "brushloop camera intrinsics" in ran.output
    assert run("check", path, *BOARD, "--lens", kept_lens(tmp_path, (1024, 800), -0.1)).exit_code == 0
    other = kept_lens(tmp_path, (640, 480), 0.0)
    message = "is 1024 x 800 px, the lens was calibrated at 640 x 480 px"
    refused(run("check", path, *BOARD, "--lens", other), message)
    other.write_text(other.read_text().replace("a board", "another"))
    refused(run("check", path, *BOARD, "--lens", other), "was edited")
    refused(run("check", tmp_path, *BOARD), "is not a file")


def points(folder: Path, change: str = "") -> Path:
    """Five marks that a robot touched, turned by 10 degrees; `change` damages the table."""
    paper = np.array([[20.0, 20.0], [150.0, 25.0], [140.0, 120.0], [30.0, 110.0], [90.0, 60.0]])
    turn = math.radians(10.0)
    rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    robot = (paper - np.array([300.0, -50.0])) @ rotation
    # The board's y counts down from 140 mm.
    drawn = np.column_stack([paper[:, 0], 140.0 - paper[:, 1]]) * PX_PER_MM + EDGE_PX - 0.5
    image = apply(SLANT, drawn)[[3, 0, 4, 1, 2] if change == "mixed" else slice(None)]
    lines = ["name,robot_x_mm,robot_y_mm,image_x_px,image_y_px"]
    lines += [
        f"p{k},{r[0]:.4f},{r[1]:.4f},{i[0]:.4f},{i[1]:.4f}" for k, (r, i) in enumerate(zip(robot, image, strict=True))
    ]
    if change == "few":
        lines = lines[:3]
    elif change == "word":
        lines[2] = lines[2].replace(lines[2].split(",")[3], "left")
    elif change == "column":
        lines[0] = lines[0].replace("image_x_px", "image_x")
    table = folder / "points.csv"
    table.write_text("\n".join(lines) + "\n")
    return table


def test_register_finds_the_turn_and_names_all_that_it_was_made_of(tmp_path: Path) -> None:
    photograph, lens = saved(tmp_path / "p.png", board()), kept_lens(tmp_path, (1024, 800), 0.0)
    words = ("register", points(tmp_path), "--photograph", photograph)
    ran = run(*words, *FLAT, "--lens", lens, "--out", tmp_path / "o")
    assert ran.exit_code == 0, ran.output
    [path] = (tmp_path / "o").iterdir()
    made = json.loads(path.read_text())
    assert made["yaw_deg"] == pytest.approx(-10.0, abs=0.01)
    assert made["rms_mm"] < 0.05
    assert made["source"].count("sha256 ") == 2
    assert f"lens file {lens.stem}" in made["source"]
    ran = run(*words, *BOARD, "--out", tmp_path / "none")
    refused(ran, "where the sheet lies on the board: is not known: give --config rig.toml")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("few", "2 points: at least 3 are needed"),
        ("mixed", "are their names mixed up?"),
        ("word", "line 3, column `image_x_px`: 'left' is not a finite number"),
        ("column", "missing: image_x_px"),
    ],
)
def test_register_writes_nothing_by_a_bad_table(tmp_path: Path, change: str, message: str) -> None:
    photograph, out = saved(tmp_path / "p.png", board()), tmp_path / "out"
    refused(run("register", points(tmp_path, change), "--photograph", photograph, *FLAT, "--out", out), message)
    assert not out.exists()


def test_drift_distinguishes_a_camera_that_stays_from_one_that_was_touched(
    photographed: Photographed, tmp_path: Path
) -> None:
    ran = run("drift", photographed(tmp_path / "still", SPEC, [board(seed=k) for k in range(3)]))
    assert ran.exit_code == 0, ran.output
    assert [line.split(" s:")[0].strip() for line in ran.stdout.splitlines()[:3]] == ["0", "60", "120"]
    assert "trend " in ran.output
    ran = run("drift", photographed(tmp_path / "touched", SPEC, [board(), board(4.0, seed=1), half_hidden(), BLANK]))
    assert ran.exit_code == 5
    blank, hidden, moved = warnings_of(ran)  # half a board tells the same scale as a whole one
    assert "is blank" in blank
    assert "the board is partly hidden" in hidden
    assert "the board moved by 4.0 px" in moved


def test_a_camera_that_sinks_has_a_trend() -> None:
    sinking = drift([(k * HOUR_NS, board(seed=k, scale=1.0 + 0.001 * k)) for k in range(4)], SPEC)
    assert sinking.trend is not None
    assert sinking.trend.slope == pytest.approx(-0.001, rel=0.1)
    assert any("pix2len changed by -0.2" in line for line in sinking.warnings)


def test_drift_refuses_what_is_no_session_with_boards(photographed: Photographed, tmp_path: Path) -> None:
    assert "no such session" in str(run("drift", tmp_path / "nosuch").exception)
    refused(run("drift", photographed(tmp_path / "none", SPEC, [])), "holds no view of the board")
    ran = run("drift", photographed(tmp_path / "mirrored", SPEC, [MIRRORED, MIRRORED]))
    refused(ran, "is not seen in any of 2 photographs")


def test_intrinsics_says_of_every_photograph_why_none_was_of_use(tmp_path: Path) -> None:
    """Also of photographs with one name in several folders, and of one that is given twice."""
    (tmp_path / "left").mkdir()
    (tmp_path / "right").mkdir()
    paths = [saved(tmp_path / folder / "01.png", BLANK) for folder in ("left", "right")]
    paths += [saved(tmp_path / "left" / "02.png", MIRRORED)] * 2
    ran = run("intrinsics", *paths, *BOARD, "--out", tmp_path / "out")
    refused(ran, "4 photographs: 0 usable views of the board, at least 4 needed; left/01.png, right/01.png: is blank")
    assert "left/02.png, left/02.png (2): the photograph is mirrored" in str(ran.exception)
    assert not (tmp_path / "out").exists()
