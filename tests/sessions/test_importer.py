"""Photographs from elsewhere become a session that reads like any other."""

import math
import shutil

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.sessions.cli import app
from brushloop.sessions.export import export
from brushloop.sessions.imports import ImportOptions
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Source
from tests.command import brushloop

START = {"start_x_px": "1", "start_y_px": "1"}
ROWS = [
    {"file": "a.png", "px_per_mm": "12.5", "depth_mm": "13", "tilt_deg": "5"} | START,
    {"file": "b.png", "px_per_mm": "12.5", "depth_mm": "15", "tilt_deg": "10"} | START,
]


def test_presses_become_a_session_like_any_other(make, photos, out, run):
    make.photographs(photos, *ROWS)
    assert run() == out / "from-elsewhere.mcap"
    recording = Recording(out)
    header = recording.header
    assert (header.session_id, header.source, header.software) == ("from-elsewhere", Source.IMPORT, "brushloop 0")
    assert (header.licence, header.origin, header.brush) == ("CC0-1.0", "a museum", "wolf")
    captures = list(recording.captures())
    assert [capture.still_png for capture in captures] == [make.png(0), make.png(1)]
    stroke = captures[1].stroke
    assert (stroke.stroke_id, stroke.kind, stroke.depth_mm, stroke.tilt_deg) == ("b", "press", 15.0, 10.0)
    assert stroke.px_per_mm == (12.5, 12.5)
    assert [path.name for path in out.parent.iterdir()] == ["from-elsewhere"]


def test_the_brush_is_as_large_as_was_given(make, photos, out, run):
    make.photographs(photos, *ROWS)
    run(ImportOptions(kind="press", brush_radius_mm=4.0, brush_length_mm=31.0))
    header = Recording(out).header
    assert (header.brush_radius_mm, header.brush_length_mm) == (4.0, 31.0)


def test_simulated_ink_is_declared_by_who_imports_it(make, photos, out, run):
    make.photographs(photos, *ROWS)
    run(ImportOptions(kind="press", simulated=True))
    source = Recording(out).header.source
    assert source is Source.IMPORT_SIMULATED
    assert source.imported


def test_the_origin_is_the_folder_and_its_table_unless_it_is_given(make, photos, out, run):
    make.photographs(photos, *ROWS)
    run(ImportOptions())
    assert Recording(out).header.origin == "photos, table.csv"


def test_units_are_converted_and_the_anchor_is_kept(make, photos, out, run):
    row = {"file": "a.png", "start_x_px": "3", "start_y_px": "4.5", "depth_nominal": "0.4", "ink_frac": "0.9"}
    lengths = {"reach_cm": "2", "span_m": "0.01", "bend_in": "1", "turn_rad": str(math.pi), "yaw_deg": "7"}
    make.photographs(photos, row | lengths)
    run(ImportOptions(px_per_mm=8.0))
    [capture] = Recording(out).captures()
    assert capture.stroke.anchor_px == (3.0, 4.5)
    assert capture.stroke.px_per_mm == (8.0, 8.0)
    assert capture.stroke.commanded == pytest.approx(
        {
            "depth_nominal": 0.4,
            "ink_frac": 0.9,
            "reach_mm": 20.0,
            "span_mm": 10.0,
            "bend_mm": 25.4,
            "turn_deg": 180.0,
            "yaw_deg": 7.0,
        }
    )


def test_a_table_may_come_from_a_spreadsheet(make, photos, out, run):
    """Byte order mark, CRLF, quotes, an empty last line, photographs in sub-folders, one scale per axis."""
    (photos / "day 1").mkdir(parents=True)
    shutil.copy(make.photographs(photos, ROWS[0]).with_name("a.png"), photos / "day 1" / "ä, 1.png")
    text = '\ufefffile, px_per_mm_x ,px_per_mm_y\r\n"day 1/ä, 1.png",10,20\r\n,,\r\n\r\n'
    (photos / "table.csv").write_text(text, encoding="utf-8", newline="")
    run(ImportOptions())
    [capture] = Recording(out).captures()
    assert capture.stroke.stroke_id == "day 1/ä, 1"
    assert capture.stroke.px_per_mm == (10.0, 20.0)


def test_every_photograph_is_decoded_once(make, photos, run, monkeypatch):
    make.photographs(photos, *ROWS)
    decoded = []
    imdecode = cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda *args: decoded.append(1) or imdecode(*args))
    run()
    assert len(decoded) == 2


def test_what_a_killed_import_left_is_cleared_away(make, photos, out, run):
    make.photographs(photos, *ROWS)
    stage = out.with_name(".from-elsewhere.partial")
    stage.mkdir(parents=True)
    (stage / "from-elsewhere.mcap.part").write_bytes(b"half")
    run()
    assert not stage.exists()


def test_the_command_imports(make, photos, out):
    make.photographs(photos, *ROWS)
    arguments = ["import", str(photos), "--csv", str(photos / "table.csv"), "--out", str(out), "--kind", "press"]
    ran = CliRunner().invoke(app, arguments)
    assert (ran.exit_code, ran.output) == (0, f"Imported into {out / 'from-elsewhere.mcap'}\n")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda photos: (photos / "b.png").unlink(), "file 'b.png' is not in photos/"),
        (lambda photos: (photos / "b.png").write_bytes(b"\x89PNG\r\n\x1a\n"), "b.png: is not a complete PNG or JPEG"),
        (lambda photos: (photos / "table.csv").write_text("file\n"), "column `px_per_mm`"),
    ],
    ids=["missing", "unreadable", "no scale"],
)
def test_a_refusal_is_one_line_on_stderr_and_exit_code_2(make, tmp_path, photos, damage, message):
    make.photographs(photos, *ROWS)
    damage(photos)
    before = make.tree(tmp_path)
    ran = brushloop("sessions", "import", "photos", "--csv", "photos/table.csv", cwd=tmp_path)
    assert ran.returncode == 2
    assert ran.stdout == ""
    assert "Traceback" not in ran.stderr
    assert message in ran.stderr.splitlines()[-1]  # on a slow machine, progress comes before it
    assert make.tree(tmp_path) == before


def turned_jpeg(image, orientation):
    """A JPEG of the image with this EXIF orientation."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    tiff = b"MM\0*\0\0\0\x08\0\x01" + b"\x01\x12\0\x03\0\0\0\x01" + orientation.to_bytes(2, "big") + bytes(6)
    exif = b"Exif\0\0" + tiff
    return data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]


def test_a_photograph_is_stored_as_a_viewer_shows_it(photos, out, run, tmp_path):
    """A person found the dark square near the upper right corner of the picture that a viewer turned."""
    stored = np.full((60, 40), 230, np.uint8)
    stored[2:8, 2:8] = 20
    photos.mkdir()
    (photos / "a.jpg").write_bytes(turned_jpeg(stored, 6))
    (photos / "b.jpg").write_bytes(turned_jpeg(stored, 1))
    (photos / "table.csv").write_text("file,px_per_mm,start_x_px,start_y_px\na.jpg,10,55,5\nb.jpg,10,5,5\n")
    run(ImportOptions())
    for name in ("npz", "png"):
        export(out, tmp_path / name, name)
    with np.load(tmp_path / "npz" / "strokes.npz") as arrays:
        in_npz = [arrays["image_0000"], arrays["image_0001"]]
    as_stored = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    in_png = [cv2.imread(str(path), as_stored) for path in sorted((tmp_path / "png" / "images").iterdir())]
    for image, other, capture in zip(in_npz, in_png, Recording(out).captures(), strict=True):
        x_px, y_px = capture.stroke.anchor_px
        assert image[int(y_px), int(x_px)] < 60
        assert image.shape == other.shape
        assert np.abs(image.astype(int) - other).max() <= 1
    assert [image.shape for image in in_npz] == [(40, 60), (60, 40)]
    assert list(Recording(out).captures())[1].still_png == (photos / "b.jpg").read_bytes()
