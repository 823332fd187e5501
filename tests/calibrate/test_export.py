"""Exports: what other tools read back is what was recorded, formulas are text, and a folder is whole or not there."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.calibrated import calibrate_session
from brushloop.calibrate.commands import CalibrateRequest, ExportRequest
from brushloop.calibrate.compare import ANCHOR_MM, field_around
from brushloop.calibrate.errors import StrokesLeftOut
from brushloop.calibrate.export import export
from brushloop.calibrate.stats import odd_waits, waits_of
from brushloop.sessions.disk import as_cell, as_text, number
from brushloop.sessions.errors import InputError, SessionError
from brushloop.sessions.events import CaptureResult, PressResult, StepKind
from brushloop.sessions.imports import ImportOptions
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Check, Quality, Topic, Wrench
from tests.calibrate.given import iou, rows_of
from tests.calibrate.simulated_rigs import collected, sheet, true_mask
from tests.command import refused, said
from tests.sessions.conftest import no_space


@pytest.fixture
def to(tmp_path):
    return tmp_path / "exported"


def test_the_photographs_are_those_of_the_recording_byte_for_byte(make, closed, to):
    to.mkdir()  # an empty folder is used
    assert said("sessions", "export", closed, to) == f"Exported into {to}"
    strokes = rows_of(to / "strokes.csv")
    assert [row["stroke_id"] for row in strokes] == ["H13-a05-r00", "H13-a05-r01"]
    assert [(to / row["file"]).read_bytes() for row in strokes] == [make.png(0), make.png(1)]
    assert {row["source"] for row in strokes} == {"loopback rig"}
    assert json.loads((to / "header.json").read_text())["exported_from"]["sha256"] == Recording(closed).sha256


def test_the_poses_of_each_press_are_a_time_series_of_its_stroke(make, closed, to):
    export(ExportRequest(closed, to, "csv"))
    poses = rows_of(to / "poses.csv")
    frames = [(row["episode_index"], row["frame_index"]) for row in poses]
    assert frames == [(str(episode), str(frame)) for episode in range(2) for frame in range(5)]
    assert [int(row["sequence"]) for row in poses[5:]] == [100, 101, 102, 103, 104]
    assert int(poses[5]["t_ns"]) == make.pose(100).publish_ns
    assert [float(poses[0][c]) for c in ("x_mm", "y_mm", "z_mm", "qw")] == [1.0, 2.0, 3.0, 1.0]


def test_what_was_commanded_reached_and_waited_are_columns_and_what_is_not_given_is_empty(make, tmp_path, to):
    values = {"depth_mm": 13.0, "reached_mm": 12.9, "anchor_mm": (1.5, 2.5), "commanded": {"length_mm": 30.0}}
    fields = [{}, *({"dip_to_touch_s": wait} for wait in (1.0, 1.1, 10.0)), values | {"dip_to_touch_s": 1.2}]
    messages = [message for n, given in enumerate(fields) for message in (make.still(n), make.stroke(n, **given))]
    export(ExportRequest(make.record(tmp_path / "a.mcap", *messages), to, "csv"))
    rows = rows_of(to / "strokes.csv")
    columns = ("depth_mm", "reached_mm", "start_x_mm", "start_y_mm", "commanded_length_mm")
    assert [rows[0][c] for c in columns] == [""] * 5
    assert [rows[-1][c] for c in columns] == ["13.0", "12.9", "1.5", "2.5", "30.0"]
    assert [row["dip_to_touch_s"] for row in rows] == ["", "1.0", "1.1", "10.0", "1.2"]
    assert [row["dip_to_touch_unlike"] for row in rows] == ["", "0.0", "0.0", "1.0", "0.0"]


def test_force_and_quality_are_exported_with_each_stroke(make, tmp_path, to):
    store = make.store(tmp_path / "felt")
    torque = {"mx_nm": 0.0, "my_nm": 0.0, "mz_nm": 0.0}
    pushes = [
        Outgoing(Topic.WRENCH, 10 + n, 10 + n, n, Wrench(fx_n=0.1, fy_n=0.0, fz_n=-float(n), **torque))
        for n in range(2)
    ]
    make.take(store, "a press", [*pushes, make.pose(0)], PressResult(press=make.press()), 0)
    dry = Check(name="dry", score=0.2, threshold=0.1, passed=False, reason="is dry")
    checks = (dry, Check(name="faint", score=0.9, threshold=0.8, passed=True))
    judged = Outgoing(Topic.QUALITY, 30, 30, 0, Quality(stroke_id="H13-a05-r00", checks=checks))
    make.take(store, "a capture", [make.still(0), judged, make.stroke(0)], make.captured("H13-a05-r00", 0))
    store.close()
    store.release()
    export(ExportRequest(store.folder, to, "csv"))
    forces = [(row["episode_index"], row["frame_index"], row["fz_n"]) for row in rows_of(to / "forces.csv")]
    assert forces == [("0", "0", "-0.0"), ("0", "1", "-1.0")]
    [stroke] = rows_of(to / "strokes.csv")
    assert (stroke["quality"], stroke["marked_bad"]) == ("failed: dry", "")


def test_parquet_has_the_same_columns(closed, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    for kind in ("csv", "parquet"):
        export(ExportRequest(closed, tmp_path / kind, kind))
    for name in ("strokes", "poses"):
        table = parquet.read_table(tmp_path / "parquet" / f"{name}.parquet")
        rows = rows_of(tmp_path / "csv" / f"{name}.csv")
        assert table.column_names == list(rows[0])
        for row, texts in zip(table.to_pylist(), rows, strict=True):
            assert {key: "" if value is None else str(value) for key, value in row.items()} == texts


def test_without_pyarrow_the_error_names_the_remedy_and_nothing_is_left(closed, to, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="parquet needs pyarrow: pip install pyarrow"):
        export(ExportRequest(closed, to, "parquet"))
    assert list(to.parent.glob("*exported*")) == []


def test_a_full_disk_leaves_nothing_and_a_folder_that_holds_anything_is_left_as_it_is(closed, to, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.sessions.disk.fsync_folder", no_space)
        with pytest.raises(SessionError, match="No space left"):
            export(ExportRequest(closed, to, "csv"))
    assert list(to.parent.glob("*exported*")) == []
    to.mkdir()
    (to / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not an empty folder"):
        export(ExportRequest(closed, to, "csv"))
    assert [path.name for path in to.iterdir()] == ["notes.txt"]


def test_names_that_a_file_system_would_refuse_become_names(make, tmp_path, to):
    strokes = [make.stroke(n, stroke_id=name) for n, name in enumerate(["../../etc/x", "a/b", "a_b", "墨" * 90])]
    path = make.record(tmp_path / "a.mcap", *(make.still(n) for n in range(4)), *strokes)
    export(ExportRequest(path, to, "csv"))
    names = sorted(p.name for p in (to / "images").iterdir())
    assert names == ["0000-______etc_x.png", "0001-a_b.png", "0002-a_b.png", f"0003-{'_' * 80}.png"]


# Crops


def test_crops_and_masks_lie_over_the_true_marks(tmp_path: Path, to: Path) -> None:
    shot = sheet(0, 2)
    session = collected(tmp_path / "pressed", shot)
    words = "sessions", "export", session, to, "--crops"
    assert f"is not calibrated: run `brushloop calibrate {session}`" in refused(*words)
    assert not to.exists()
    calibrate_session(CalibrateRequest(session))
    said(*words)
    rows = rows_of(to / "strokes.csv")
    assert [row["stroke_id"] for row in rows] == ["s0", "s1"]
    for row, anchor in zip(rows, shot.anchors_mm, strict=True):
        crop, mask = (cv2.imread(str(to / row[name]), cv2.IMREAD_GRAYSCALE) for name in ("file", "mask_file"))
        assert crop.shape == mask.shape == (768, 768)
        assert (float(row["px_per_mm_x"]), float(row["px_per_mm_y"])) == (20.0, 20.0)
        left, top = (20.0 * v for v in ANCHOR_MM)
        assert (float(row["start_x_px"]), float(row["start_y_px"])) == pytest.approx((left, top))
        truth = true_mask(shot, field_around(anchor), 20.0)
        assert iou(mask > 0, truth) >= 0.9
        assert crop[mask > 0].mean() < 0.5 * crop[mask == 0].mean()


@pytest.mark.parametrize("inked", [True, False])
def test_imports_are_rescaled_and_what_cannot_be_cropped_is_named(make, tmp_path, photos, run, to, inked):
    """The second photograph, or both, are blank."""
    image = np.full((300, 400), 225, np.uint8)
    blank = cv2.imencode(".png", image)[1].tobytes()
    cv2.ellipse(image, (200, 150), (60, 20), 0, 0, 360, 25, -1)
    rows = [{"file": f"{k}.png", "px_per_mm": "10", "depth_mm": "13"} for k in range(2)]
    make.photographs(photos, *rows)
    (photos / "1.png").write_bytes(blank)
    (photos / "0.png").write_bytes(cv2.imencode(".png", image)[1].tobytes() if inked else blank)
    ran = CliRunner().invoke(app, ["sessions", "export", str(run(ImportOptions("drag"))), str(to), "--crops"])
    if not inked:
        assert "holds no stroke that can be cropped: 0 is blank" in str(ran.exception)
        assert not to.exists()
        return
    assert isinstance(ran.exception, StrokesLeftOut)
    assert ran.exception.exit_code == 3
    assert "left out: 1: is blank" in ran.output
    [row] = rows_of(to / "strokes.csv")
    assert row["mask_file"] == "masks/0000-0.png"
    mask = cv2.imread(str(to / row["mask_file"]), cv2.IMREAD_GRAYSCALE)
    assert mask.shape == (600, 800)
    assert (mask > 0).sum() / 20.0**2 == pytest.approx(np.pi * 6 * 2, rel=0.05)


# Waits from dip to touch


def test_a_wait_belongs_to_the_take_that_the_photograph_shows(make, store):
    for still, wait_s in ((3, 1.1), (6, 7.0), (9, None)):
        captured = CaptureResult(press=make.press("a", dip_to_touch_s=wait_s), still=still)
        store.done(store.begin(f"k{still}", StepKind.CAPTURE), captured)
    assert waits_of(store.state) == {3: 1.1, 6: 7.0}


@pytest.mark.parametrize(
    ("waits", "far"),
    [
        ([1.0, 1.1, 9.0], []),  # three cannot tell which of them is the odd one
        ([1.0, 1.1, 1.2, 3.1], []),  # less than two seconds
        ([1.0, 1.1, 1.2, 3.2], [3]),
        ([4.0, 8.0, 12.0, 16.0, 20.0], []),  # a session whose waits spread widely anyhow
        ([20.0, 20.1, 20.0, 5.0, 20.2], [3]),  # too early counts as well
        ([], []),
    ],
)
def test_far_is_two_seconds_and_three_median_deviations(waits: list[float], far: list[int]):
    assert list(odd_waits(dict(enumerate(waits)))) == far


# Cells of a CSV file


def test_names_go_out_and_in_again_by_our_own_importer(make, photos, run, to):
    names = ["=1+1", "@home", "-2-3", "-5", "'=x", "＝1", "it's", "字"]
    rows = [{"file": f"{k}.png", "name": str(as_cell(name)), "px_per_mm": "5"} for k, name in enumerate(names)]
    make.photographs(photos, *rows)
    recorded = run(ImportOptions("drag"))
    assert [stroke.stroke_id for stroke in Recording(recorded).stroke_records()] == names
    export(ExportRequest(recorded, to, "csv"))
    cells = [row["stroke_id"] for row in rows_of(to / "strokes.csv")]
    assert cells == ["'=1+1", "'@home", "'-2-3", "-5", "''=x", "'＝1", "it's", "字"]
    assert [as_text(cell) for cell in cells] == names


@pytest.mark.parametrize("text", ["1_0", "1e1_0", "nan", "-inf", "1e999", "", "0x10", "1,5", "1 0", "１０"])
def test_what_nobody_writes_as_a_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a finite number"):
        number(text)
