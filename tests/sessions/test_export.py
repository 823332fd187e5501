"""Exports: what other tools read back is what was recorded, and a folder is whole or not there."""

import csv
import json
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.sessions.errors import InputError, SessionError
from brushloop.sessions.events import PressResult
from brushloop.sessions.export import export
from brushloop.sessions.mcap_writer import Outgoing
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Check, Quality, Topic, Wrench


@pytest.fixture
def session(make, store):
    """A closed session of two strokes, five poses each."""
    make.collect(store)
    store.close()
    store.release()
    return store.folder


@pytest.fixture
def to(tmp_path):
    return tmp_path / "exported"


@pytest.fixture
def few(make, tmp_path):
    """A recording of two strokes, of which only the second has values."""
    values = {"depth_mm": 13.0, "reached_mm": 12.9, "anchor_mm": (1.5, 2.5), "commanded": {"length_mm": 30.0}}
    return make.record(tmp_path / "a.mcap", make.still(0), make.stroke(0), make.still(1), make.stroke(1, **values))


@pytest.fixture
def felt(make, tmp_path):
    """A recording of a judged press with two samples of force."""
    store = make.store(tmp_path / "felt")
    pushes = [
        Outgoing(
            Topic.WRENCH, 10 + n, 10 + n, n, Wrench(fx_n=0.1, fy_n=0.0, fz_n=-float(n), mx_nm=0.0, my_nm=0.0, mz_nm=0.0)
        )
        for n in range(2)
    ]
    make.take(store, "a press", [*pushes, make.pose(0)], PressResult(press=make.press()), 0)
    checks = (Check(name="dry", passed=False, reason="is dry"), Check(name="faint", passed=True))
    judged = Outgoing(Topic.QUALITY, 30, 30, 0, Quality(stroke_id="H13-a05-r00", checks=checks))
    taken = [make.still(0), judged, make.stroke(0)]
    make.take(store, "a capture", taken, make.captured("H13-a05-r00", 0))
    store.close()
    store.release()
    return store.folder


def rows_of(table):
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_png_and_csv_hold_the_photographs_byte_for_byte(make, session, to):
    to.mkdir()  # an empty folder is used
    export(session, to, "png")
    strokes = rows_of(to / "strokes.csv")
    assert [row["stroke_id"] for row in strokes] == ["H13-a05-r00", "H13-a05-r01"]
    assert [(to / row["file"]).read_bytes() for row in strokes] == [make.png(0), make.png(1)]
    assert {row["source"] for row in strokes} == {"loopback rig"}
    assert json.loads((to / "header.json").read_text())["exported_from"]["sha256"] == Recording(session).sha256


def test_the_poses_of_each_press_are_a_time_series_of_its_stroke(make, session, to):
    export(session, to, "png")
    poses = rows_of(to / "poses.csv")
    frames = [(row["episode_index"], row["frame_index"]) for row in poses]
    assert frames == [(str(episode), str(frame)) for episode in range(2) for frame in range(5)]
    assert [int(row["sequence"]) for row in poses[5:]] == [100, 101, 102, 103, 104]
    assert int(poses[5]["t_ns"]) == make.pose(100).publish_ns
    assert [float(poses[0][c]) for c in ("x_mm", "y_mm", "z_mm", "qw")] == [1.0, 2.0, 3.0, 1.0]


def test_what_was_commanded_and_reached_are_columns_and_what_is_not_given_is_empty(few, tmp_path):
    columns = ("depth_mm", "reached_mm", "anchor_x_mm", "anchor_y_mm", "commanded_length_mm")
    export(few, tmp_path / "png", "png")
    assert [[row[c] for c in columns] for row in rows_of(tmp_path / "png" / "strokes.csv")] == [
        [""] * 5,
        ["13.0", "12.9", "1.5", "2.5", "30.0"],
    ]
    export(few, tmp_path / "npz", "npz")
    with np.load(tmp_path / "npz" / "strokes.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(
            [arrays[c] for c in columns], [[np.nan, 13.0], [np.nan, 12.9], [np.nan, 1.5], [np.nan, 2.5], [np.nan, 30.0]]
        )


def test_force_and_quality_are_exported_with_each_stroke(felt, to):
    export(felt, to, "png")
    forces = [(row["episode_index"], row["frame_index"], row["fz_n"]) for row in rows_of(to / "forces.csv")]
    assert forces == [("0", "0", "-0.0"), ("0", "1", "-1.0")]
    [stroke] = rows_of(to / "strokes.csv")
    assert (stroke["quality"], stroke["marked_bad"]) == ("failed: dry", "")


def test_npz_loads_without_pickle(make, session, felt, to):
    export(session, to, "npz")
    with np.load(to / "strokes.npz", allow_pickle=False) as arrays:
        assert arrays["stroke_id"].tolist() == ["H13-a05-r00", "H13-a05-r01"]
        np.testing.assert_array_equal(arrays["image_0001"], decode_gray(make.png(1), "made"))
        assert arrays["pose_position_mm"].shape == (10, 3)
        assert arrays["pose_t_ns"].dtype == np.int64
        assert arrays["pose_episode_index"].tolist() == [0] * 5 + [1] * 5
    export(felt, to.with_name("felt-out"), "npz")
    with np.load(to.with_name("felt-out") / "strokes.npz", allow_pickle=False) as arrays:
        assert arrays["force_wrench"].shape == (2, 6)
        assert arrays["quality"].tolist() == ["failed: dry"]


def test_equal_recordings_make_equal_arrays(few, tmp_path):
    for name in ("out", "again"):
        export(few, tmp_path / name, "npz")
    assert (tmp_path / "out" / "strokes.npz").read_bytes() == (tmp_path / "again" / "strokes.npz").read_bytes()


def test_parquet_is_what_datasets_reads(make, session, to):
    parquet = pytest.importorskip("pyarrow.parquet")
    export(session, to, "parquet")
    table = parquet.read_table(to / "strokes" / "train-00000-of-00001.parquet")
    assert [image["bytes"] for image in table["image"].to_pylist()] == [make.png(0), make.png(1)]
    features = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert features["image"] == {"_type": "Image"}
    assert features["depth_mm"] == {"dtype": "float64", "_type": "Value"}
    assert list(features) == table.column_names

    poses = parquet.read_table(to / "poses" / "train-00000-of-00001.parquet")
    assert poses["episode_index"].to_pylist() == [0] * 5 + [1] * 5
    assert poses["timestamp"].to_pylist()[:3] == [0.0, 1e-9, 2e-9]
    assert poses["observation.state"].to_pylist()[0] == [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
    state = json.loads(poses.schema.metadata[b"huggingface"])["info"]["features"]["observation.state"]
    assert (state["_type"], state["length"]) == ("Sequence", 7)
    card = (to / "README.md").read_text()
    assert "path: strokes/train-*.parquet" in card
    assert "Source: **loopback rig**" in card


@pytest.mark.soak  # importing `datasets` takes longer than everything else here
def test_hugging_face_datasets_loads_strokes_poses_and_forces(make, felt, to):
    datasets = pytest.importorskip("datasets", reason="needs `pip install datasets`, which the lock leaves out")
    export(felt, to, "parquet")
    cache = str(to.parent / "cache")
    strokes, poses, forces = (
        datasets.load_dataset(str(to), name, split="train", cache_dir=cache) for name in ("strokes", "poses", "forces")
    )
    assert strokes[0]["stroke_id"] == "H13-a05-r00"
    np.testing.assert_array_equal(strokes[0]["image"], decode_gray(make.png(0), "made"))
    assert poses[0]["observation.state"][:3] == [1.0, 2.0, 3.0]
    assert forces[1]["observation.force"] == [0.1, 0.0, -1.0, 0.0, 0.0, 0.0]


def test_without_pyarrow_the_error_names_the_remedy_and_nothing_is_left(session, to, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="parquet needs pyarrow: pip install pyarrow"):
        export(session, to, "parquet")
    assert list(to.parent.glob("*exported*")) == []


@pytest.mark.parametrize("kind", ["png", "npz", "parquet"])
def test_a_full_disk_leaves_nothing(few, tmp_path, to, kind, monkeypatch):
    def full(_):
        raise OSError(28, "No space left")

    monkeypatch.setattr("brushloop.sessions.disk.fsync_folder", full)
    with pytest.raises(SessionError, match="No space left"):
        export(few, to, kind)
    assert list(tmp_path.glob("*exported*")) == []


def test_a_damaged_photograph_leaves_nothing(make, tmp_path, to):
    path = make.record(tmp_path / "a.mcap", make.still(0, b"no image"), make.stroke(0))
    with pytest.raises(SessionError, match="stroke H13-a05-r00: is not a complete PNG or JPEG image"):
        export(path, to, "npz")
    assert list(tmp_path.glob("*exported*")) == []


def test_a_folder_that_holds_anything_is_left_as_it_is(session, to):
    to.mkdir()
    (to / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not an empty folder"):
        export(session, to, "png")
    assert [path.name for path in to.iterdir()] == ["notes.txt"]


def test_names_that_a_file_system_would_refuse_become_names(make, tmp_path, to):
    strokes = [make.stroke(n, stroke_id=name) for n, name in enumerate(["../../etc/x", "a/b", "a_b", "墨" * 90])]
    path = make.record(tmp_path / "a.mcap", *(make.still(n) for n in range(4)), *strokes)
    export(path, to, "png")
    names = sorted(p.name for p in (to / "images").iterdir())
    assert names == ["0000-______etc_x.png", "0001-a_b.png", "0002-a_b.png", f"0003-{'_' * 80}.png"]


def test_an_unknown_format_is_refused(session, to):
    with pytest.raises(InputError, match="'zarr', allowed: png, npz, parquet"):
        export(session, to, "zarr")


def test_the_command(session, to):
    ran = CliRunner().invoke(app, ["sessions", "export", str(session), str(to), "--format", "npz"])
    assert (ran.exit_code, ran.output) == (0, f"Exported into {to}\n")
