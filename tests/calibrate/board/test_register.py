"""`camera register`: where the robot's points lie on the paper, and how rig.toml comes to say so."""

from __future__ import annotations

import dataclasses
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from brushloop.__main__ import app
from brushloop.calibrate.board.register import Registration, read_rig, register
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.rig.config import PaperConfig, RigConfig, load_rig
from brushloop.collect.rig.paper import to_base
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.rig import Addresses, rig_toml
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World

ROBOT = np.array([[460.0, -110.0], [460.0, 100.0], [310.0, 100.0], [310.0, -110.0], [380.0, 0.0], [420.0, 50.0]])
AT = Addresses("127.0.0.1", 1, 2, 3, None, None)
MARKS = [(10.0, 10.0), (230.0, 15.0), (220.0, 160.0), (15.0, 155.0), (120.0, 80.0)]
"""Where the robot touched, in the paper frame."""


def seen(scale: float = 1.0) -> np.ndarray:
    """The points as the camera sees them on the paper, which is turned by -90 degrees; off by 0.05 mm."""
    matrix = scale * np.array([[0.0, 1.0], [-1.0, 0.0]])
    return ROBOT @ matrix.T + [110.0, 460.0] + np.random.default_rng(2).normal(0, 0.05, ROBOT.shape)


def registered(seen_mm: np.ndarray, robot_mm: np.ndarray = ROBOT) -> Registration:
    return register([f"touch {k}" for k in range(len(robot_mm))], robot_mm, seen_mm, "points.csv", (-34.0, -34.0))


def test_turn_and_place_are_found_and_a_point_that_slipped_does_not_pull() -> None:
    marks = seen()
    fitted = registered(marks)
    assert fitted.yaw_deg == pytest.approx(90.0, abs=0.05)
    assert fitted.rms_mm < fitted.left_out_rms_mm < 0.2
    assert np.column_stack([ROBOT, np.ones(6)]) @ fitted.matrix.T == pytest.approx(marks, abs=0.3)
    assert np.append(fitted.origin_mm, 1.0) @ fitted.matrix.T == pytest.approx([0.0, 0.0])
    marks[3] += (4.0, -2.0)
    slipped = registered(marks)
    assert list(slipped.dropped) == ["touch 3"]
    assert slipped.dropped["touch 3"] == pytest.approx([4.0, -2.0], abs=0.3)
    assert slipped.yaw_deg == pytest.approx(90.0, abs=0.05)


def test_a_board_printed_too_small_shows_in_the_residuals() -> None:
    assert registered(seen()).rms_mm < 0.1
    assert registered(seen(scale=0.99)).rms_mm > 0.5


def test_points_in_one_place_or_of_no_sheet_are_refused() -> None:
    with pytest.raises(CalibrationError, match="within 1 mm"):
        registered(seen(), ROBOT * 0.001)
    with pytest.raises(CalibrationError, match="mixed up"):
        registered(np.random.default_rng(0).uniform(0, 200, ROBOT.shape))


@dataclasses.dataclass(frozen=True)
class PlacedSheet:
    """A sheet that lies somewhere, and what an operator has of it: marks, a photograph, and an old rig.toml."""

    truth: PaperConfig
    table: Path
    photograph: Path
    rig: Path

    def register(self, *options: object) -> Result:
        out = self.rig.parent / "camera"
        words = ("camera", "register", self.table, "--photograph", self.photograph, "--out", out, *options)
        return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module", params=[(73.2, (431.5, -92.25)), (-110.0, (380.0, 140.0))], ids=["left", "right"])
def placed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PlacedSheet:
    yaw_deg, origin_mm = request.param
    view = View(width_px=1024, height_px=768, px_per_mm=3.125)
    world = World(SimConfig(view=view, table=Table(origin_mm=origin_mm, yaw_deg=yaw_deg)))
    scene, folder = Scene(world), tmp_path_factory.mktemp("placed")
    photograph, table, rig = folder / "marks.png", folder / "marks.csv", folder / "rig.toml"
    cv2.imwrite(str(photograph), scene.render(0, brush_pose(*world.config.home_mm)))
    truth = PaperConfig(origin_mm=origin_mm, yaw_deg=yaw_deg, touch_z_mm=120.0, size_mm=world.config.table.sheet_mm)
    rows = ["name,robot_x_mm,robot_y_mm,image_x_px,image_y_px"]
    for k, mark in enumerate(MARKS):
        x, y = to_base(truth, *mark)
        assert world.to_paper(x, y) == pytest.approx(mark), "the rig's own geometry is the same"
        u, v = scene.optics.image_of(np.array([mark]))[0]
        rows.append(f"mark {k},{x:.4f},{y:.4f},{u:.3f},{v:.3f}")
    table.write_text("\n".join(rows) + "\n")
    rig.write_text(rig_toml(SimConfig(), AT).replace("yaw_deg = 90.0\n", "yaw_deg = 90.0  # by eye\n"))
    return PlacedSheet(truth, table, photograph, rig)


def lies_there(paper: PaperConfig, truth: PaperConfig) -> None:
    """Wherever a press is meant on the sheet, the arm goes there to within a tenth of a millimetre."""
    for mark in MARKS:
        assert to_base(paper, *mark) == pytest.approx(to_base(truth, *mark), abs=0.1)
    assert paper.yaw_deg == pytest.approx(truth.yaw_deg, abs=0.03)


def rest(rig: RigConfig) -> object:
    return rig.model_dump(exclude={"paper": {"origin_mm", "yaw_deg"}})


def test_the_last_two_lines_are_those_of_the_rig(placed: PlacedSheet) -> None:
    ran = placed.register("--config", placed.rig)
    assert ran.exit_code == 0, ran.output
    pasted = tomllib.loads("\n".join(ran.output.splitlines()[-2:]))
    assert list(pasted) == ["origin_mm", "yaw_deg"]
    lies_there(placed.truth.model_copy(update=pasted), placed.truth)


def test_write_changes_these_two_values_and_nothing_else(placed: PlacedSheet, tmp_path: Path) -> None:
    placed = dataclasses.replace(placed, rig=Path(shutil.copy(placed.rig, tmp_path)))
    before, old = placed.rig.read_bytes(), load_rig(placed.rig)
    placed.rig.chmod(0o640)
    ran = placed.register("--write", placed.rig)
    assert ran.exit_code == 0, ran.output
    new = load_rig(placed.rig)
    lies_there(new.paper, placed.truth)
    assert rest(new) == rest(old)
    rows = zip(placed.rig.read_text().splitlines(), before.decode().splitlines(), strict=True)
    changed = [row for row, was in rows if row != was]
    assert len(changed) == 2
    assert changed[1].endswith("  # by eye")
    assert placed.rig.stat().st_mode & 0o777 == 0o640
    placed.register("--write", placed.rig)
    assert placed.rig.with_name("rig.toml.bak").read_bytes() == before, "what was kept is never overwritten"
    assert placed.rig.with_name("rig.toml.bak-2").exists()


BOARD = "[board]\nsquares = [9, 7]\nsquare_mm = 20.0\nmarker_mm = 15.0\norigin_mm = [-3.0, -4.0]\n"
SOUND = f"{BOARD}[paper]\norigin_mm = [1, 2] # here\nyaw_deg = 0\n"
WRITTEN = f"{BOARD}[paper]\norigin_mm = [460.123, 0.0] # here\nyaw_deg = 90.0\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (SOUND.replace("\n", "\r\n"), WRITTEN.replace("\n", "\r\n")),
        (SOUND.replace("[1, 2]", "[1,\n2]"), WRITTEN),
        (SOUND.replace("yaw_deg = 0\n", ""), WRITTEN),
        (
            f"[ paper ] # sheet\nyaw_deg=1\n  origin_mm=[1,\t2]\n{BOARD}",
            f"[ paper ] # sheet\nyaw_deg=90.0\n  origin_mm=[460.123, 0.0]\n{BOARD}",
        ),
    ],
    ids=["line ends of Windows", "two lines", "no yaw", "another order"],
)
def test_only_the_values_change_in_the_text(tmp_path: Path, text: str, expected: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_bytes(text.encode())
    rounded = registered(seen()).model_copy(update={"origin_mm": (460.12345, -0.00001), "yaw_deg": 90.00001})
    read_rig(path).write(rounded.paper)
    assert path.read_bytes().decode() == expected


def test_without_a_table_for_the_paper_nothing_is_written(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(BOARD)
    with pytest.raises(CalibrationError, match=r"paper: is not a table; nothing is written\. Enter by hand: origin_mm"):
        read_rig(path).write(registered(seen()).paper)
    assert path.read_text() == BOARD
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "rig.toml: [board] is missing"),
        ("[board", "is not TOML"),
        ("[board]\nsquares = [9, 7]\n", "board.square_mm: Field required"),
    ],
)
def test_a_rig_without_a_board_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(CalibrationError) as refused:
        read_rig(path)
    assert message in str(refused.value)
