"""`brushloop rig show` and `rig check`: what a rig.toml says, and what in it cannot be true."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import pytest

from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.show import places_of
from brushloop.collect.teach.store import Notebook, TaughtFile, taught
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from tests.command import brushloop


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 1, 2, 3, 4, "/dev/ttyUSB0")))
    return path


def changed(rig: Path, old: str, new: str) -> Path:
    text = rig.read_text()
    assert old in text
    rig.write_text(text.replace(old, new))
    return rig


def found(rig: Path) -> dict[str, dict[str, str]]:
    """The checks that contradict something, by name."""
    ran = brushloop("rig", "check", rig, "--json")
    page = json.loads(ran.stdout)
    wrong = {check["name"]: check for check in page["checks"] if check["verdict"] == "contradicts"}
    assert page["contradictions"] == len(wrong)
    assert ran.returncode == (5 if wrong else 0)
    return wrong


def test_the_loopback_rig_contradicts_nothing_and_what_is_missing_is_said(rig: Path) -> None:
    ran = brushloop("rig", "check", rig)
    assert ran.returncode == 0
    assert "plausible     tool length" in ran.stdout
    assert re.search(r"not measured  lens +not calibrated", ran.stdout)
    assert ran.stdout.rstrip().endswith("15 values are plausible, 0 contradict others, 7 were not measured")


@pytest.mark.parametrize(
    ("old", "new", "name", "remedy"),
    [
        ("[0.0, 0.0, 180.0]", "[0.0, 0.0, 0.18]", "tool length", "0.18 m are 180 mm"),
        ("square_mm = 12.0\nmarker_mm = 9.0", "square_mm = 0.012\nmarker_mm = 0.009", "square of the board", "12 mm"),
        ("squares = [26, 20]", "squares = [22, 16]", "board around the sheet", "print a larger one"),
        ("well_mm = [-75.0", "well_mm = [505.0", "inside the box, well", "Outside the box"),
        ("x_mm = [200.0, 640.0]", "x_mm = [200.0, 940.0]", "room in the box", "little more"),
        ("park_mm = [250.0, -230.0", "park_mm = [250.0, -100.0", "park beside the board", "in the picture"),
        ("travel_speed_mm_s = 200.0", "travel_speed_mm_s = 400.0", "travel speed", "refuses every move"),
        ("max_depth_mm = 22.0", "max_depth_mm = 47.0", "deepest press", "ferrule"),
        ("dip_z_mm = 122.0", "dip_z_mm = -122.0", "dip above the paper", "teach the well"),
    ],
)
def test_a_value_that_cannot_be_true_is_named_with_its_remedy(
    rig: Path, old: str, new: str, name: str, remedy: str
) -> None:
    check = found(changed(rig, old, new))[name]
    assert remedy in check["remedy"]
    assert check["allowed"]


def test_a_file_that_cannot_be_used_is_one_line_and_code_2(rig: Path) -> None:
    ran = brushloop("rig", "check", changed(rig, "safe_z_mm = 180.0", "safe_z_mm = 18.0"))
    assert ran.returncode == 2
    assert ran.stderr.count("\n") == 1
    assert "motion.safe_z_mm = 18 is below" in ran.stderr


def test_what_is_shown_is_where_the_tip_goes(rig: Path) -> None:
    places = {place.name: place.at_mm for place in places_of(load_rig(rig))}
    # Yaw 90: paper x runs along base y, paper y against base x.
    assert places["sheet lower right"] == pytest.approx([460.0, 134.0, 98.03])
    assert places["well"] == pytest.approx([310.0, -185.0, 122.0])
    table = brushloop("rig", "show", rig).stdout
    assert all(name in table for name in places)
    assert re.search(r"park .* 250\.0 .* -120\.0 .* 210\.0", table)


def test_the_picture_shows_the_box_and_every_place(rig: Path, tmp_path: Path) -> None:
    wipe_and_wash = (
        "[ink.wipe]\nrim_mm = [322.0, 20.0]\nz_mm = 131.0\n[ink.wash]\npot_mm = [300.0, 100.0]\ndip_z_mm = 125.0\n"
    )
    changed(rig, "[ink.device]", wipe_and_wash + "[ink.device]")
    picture = tmp_path / "rig.svg"
    assert brushloop("rig", "show", rig, "--picture", picture).returncode == 0
    drawn = picture.read_text()
    for words in ("from above", "box of limits", "board", "sheet"):
        assert f"<!-- {words}" in drawn, words
    for words in ("well", "wipe, over the rim", "wash pot", "park", "touch point"):
        assert f"<!-- {words} -->" in drawn, words


def test_a_picture_has_the_format_of_its_ending(rig: Path, tmp_path: Path) -> None:
    assert brushloop("rig", "show", rig, "--picture", tmp_path / "rig.png").returncode == 0
    drawn = cv2.imread(str(tmp_path / "rig.png"))
    assert drawn is not None
    assert drawn.shape[:2] == (704, 792)
    refused = brushloop("rig", "show", rig, "--picture", tmp_path / "rig.gif")
    assert refused.returncode == 2
    assert "must end in" in refused.stderr


def test_what_was_taught_says_what_was_never_measured(rig: Path) -> None:
    mass = taught("arm", 0.0, "as set on the pendant", "kg", known="not weighed")
    TaughtFile(rig).save(Notebook().with_values({"robot.payload_kg": mass}).finished("arm"))
    checks = {check["name"]: check for check in json.loads(brushloop("rig", "check", rig, "--json").stdout)["checks"]}
    assert checks["robot.payload_kg"]["remedy"] == "as set on the pendant, not weighed"
    assert checks["step proof"]["remedy"] == "brushloop rig teach proof --arm"
    assert checks["step proof"]["verdict"] == "not measured"
    assert "step arm" not in checks
