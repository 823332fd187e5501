"""What cannot be imported is refused in one line, which says what is allowed, and leaves no trace."""

import math
import os
import struct
import zlib

import cv2
import numpy as np
import pytest

from brushloop.sessions import imports, messages
from brushloop.sessions.errors import InputError
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.recording import Recording

START = {"start_x_px": "1", "start_y_px": "1"}
ROWS = [
    {"file": "a.png", "px_per_mm": "12.5", "depth_mm": "13", "tilt_deg": "5"} | START,
    {"file": "b.png", "px_per_mm": "12.5", "depth_mm": "15", "tilt_deg": "10"} | START,
]


def lines(*rows):
    return "\n".join(rows) + "\n"


def presses(head, *rows):
    """A table whose lines say where the presses began."""
    return lines(f"{head},start_x_px,start_y_px", *(row and f"{row},1,1" for row in rows))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "table.csv: column `file` is missing; found: none"),
        (lines("name,px_per_mm", "a.png,1"), "column `file` is missing; found: name, px_per_mm"),
        (presses("file,px_per_mm,depth_mm,tilt_deg"), "has no rows"),
        (
            lines("file,depth_mm,tilt_deg", "a.png,1,1"),
            "column `px_per_mm` (or px_per_mm_x and px_per_mm_y) is missing",
        ),
        (presses("file,px_per_mm_x,depth_mm,tilt_deg", "a.png,1,1,1"), "column `px_per_mm_y` is missing"),
        (lines("file,px_per_mm,tilt_deg", "a.png,1,1"), "column `depth_mm` is missing; presses need it"),
        (lines("file,px_per_mm,depth_mm", "a.png,1,1"), "column `tilt_deg` is missing; presses need it"),
        (
            lines("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1,1"),
            "table.csv: column `start_x_px` is missing; presses",
        ),
        (lines("file,px_per_mm,depth_mm,tilt_deg,start_x_px", "a.png,1,1,1,1"), "column `start_y_px` is missing"),
        (
            lines("file,px_per_mm,depth_mm,tilt_deg,start_x_px,start_y_px", "a.png,1,1_0,1,1,1"),
            "line 2, column `depth_mm`: '1_0' is not a finite",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg,l_furlong", "a.png,1,1,1,1"),
            "must end in one of: mm, cm, m, in, deg",
        ),
        (presses("file,px_per_mm,depth_mm,tilt_deg,l_mm,l_cm", "a.png,1,1,1,1,1"), "column `l_mm` occurs twice"),
        (presses("file,px_per_mm,depth_mm,tilt_deg,file", "a.png,1,1,1,b.png"), "column `file` occurs twice"),
        (presses("file,px_per_mm,depth_mm,tilt_deg,", "a.png,1,1,1,"), "column `` has no known unit"),
        (lines('"fi\nle",px_per_mm', "a.png,1"), "line 1 holds control characters"),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,deep,1"),
            "line 2, column `depth_mm`: 'deep' is not a fin",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1,nan"),
            "line 2, column `tilt_deg`: 'nan' is not a finite",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,inf,1,1"),
            "line 2, column `px_per_mm`: 'inf' is not a fin",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg,l_m", "a.png,1,1,1,1e308"),
            "column `l_m`: '1e308' is not a finite",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,0,1,1"),
            "line 2: px_per_mm = (0.0, 0.0), allowed: 0.01 to",
        ),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1"), "line 2 has 5 fields, expected 6"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1,1,1"), "line 2 has 7 fields, expected 6"),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1,1", "", "./a.png,1,1,1"),
            "line 4: stroke a appears twice",
        ),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "c.png,1,1,1"), "line 2: file 'c.png' is not in photos/"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", ",1,1,1"), "line 2: file '' is not in photos/"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", ".,1,1,1"), "line 2: file '.' is not in photos/"),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "../x.png,1,1,1"),
            "line 2: file '../x.png' lies outside photos/",
        ),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "/x.png,1,1,1"), "line 2: file '/x.png' lies outside photos/"),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "link.png,1,1,1"),
            "line 2: file 'link.png' lies outside photos/",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "loop.png,1,1,1"),
            "line 2: file 'loop.png' lies outside photos/",
        ),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "x" * 5000 + ",1,1,1"), "line 2: file 'xxx"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", '"a\n.png",1,1,1'), "column `file`: 'a\\n.png' holds control"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "a\0.png,1,1,1"), "line 2, column `file`: 'a\\x00.png' holds"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", "a.png,1,1,1\u2028,1"), "line 2 has 7 fields"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", '"a.png"x,1,1,1'), "line 2: ',' expected after '\"'"),
        (presses("file,px_per_mm,depth_mm,tilt_deg", '"' + "a" * 200_000), "line 2: "),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "text.png,1,1,1"),
            "photos/text.png: is not a complete PNG or JPEG image",
        ),
        (
            presses("file,px_per_mm,depth_mm,tilt_deg", "cut.png,1,1,1"),
            "photos/cut.png: is not a complete PNG or JPEG image",
        ),
    ],
    ids=lambda value: "table" if "\n" in value else value,
)
def test_a_table_that_cannot_be_used_is_refused(make, tmp_path, photos, refusal, text, message):
    make.photographs(photos, *ROWS)
    (tmp_path / "x.png").write_bytes(make.png())
    (photos / "link.png").symlink_to(tmp_path / "x.png")
    (photos / "loop.png").symlink_to(photos / "loop.png")
    (photos / "text.png").write_text("no image")
    (photos / "cut.png").write_bytes(make.png()[:-20])
    (photos / "table.csv").write_text(text, encoding="utf-8", newline="")
    line = refusal()
    assert message in line
    assert len(line) < 400


def test_an_existing_session_is_never_overwritten(make, photos, out, refusal):
    make.photographs(photos, *ROWS)
    out.mkdir(parents=True)
    assert "exists already" in refusal()


@pytest.mark.parametrize("kind", ["stamp", "", "Press"])
def test_an_unknown_kind_is_refused(make, photos, refusal, kind):
    make.photographs(photos, *ROWS)
    assert f"--kind is {kind!r}, allowed: press, drag" in refusal(ImportOptions(kind=kind))


@pytest.mark.parametrize("scale", [0.0, -1.0, math.nan, 1e9])
def test_a_scale_that_no_camera_has_is_refused(make, photos, refusal, scale):
    make.photographs(photos, {"file": "a.png"})
    assert "allowed: 0.01 to 10000" in refusal(ImportOptions(px_per_mm=scale))


def test_a_folder_or_table_that_is_not_there_is_refused(make, photos, refusal):
    assert refusal() == "photos: is not a folder of photographs"
    photos.mkdir()
    assert refusal() == "photos/table.csv: no such table"


def test_a_table_that_is_not_utf8_is_refused(make, photos, refusal):
    make.photographs(photos, *ROWS).write_bytes("file,größe_mm\n".encode("latin-1"))
    assert refusal() == "photos/table.csv: is not UTF-8 text"


def test_a_huge_table_is_refused(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)
    monkeypatch.setattr(imports, "MAX_ROWS", 1)
    assert refusal() == "photos/table.csv: has more than 1 rows"
    monkeypatch.setattr(imports, "MAX_TABLE_BYTES", 10)
    assert "larger than 10 bytes" in refusal()


def test_a_huge_photograph_is_refused(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)
    monkeypatch.setattr(messages, "MAX_IMAGE_PIXELS", 100)
    assert refusal() == "photos/a.png: image of 24 x 24 pixels exceeds 100"
    monkeypatch.setattr(imports, "MAX_IMAGE_BYTES", 10)
    assert "photos/a.png: is larger than 10 bytes" in refusal()


def test_a_name_that_is_no_session_id_is_refused(make, tmp_path, photos):
    make.photographs(photos, *ROWS)
    with pytest.raises(InputError, match="a session's name is letters"):
        import_photographs(photos, photos / "table.csv", tmp_path / "-x y", ImportOptions(), "", make.clock())


def test_a_photograph_that_changes_under_the_import_is_refused(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)
    (photos.parent / "sessions").mkdir()
    read = imports.read_bounded
    seen = []

    def change(path, max_bytes):
        seen.append(path)
        return read(path, max_bytes) + b"x" * (len(seen) > 3)

    monkeypatch.setattr(imports, "read_bounded", change)
    assert refusal() == "photos/a.png: changed while it was imported"


def test_a_disk_without_room_is_refused(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "mkdir", full)
    assert refusal() == "sessions/from-elsewhere: cannot write: No space left on device"


def test_a_damaged_photograph_is_reported_by_us_and_not_by_a_library_on_stderr(make, photos, refusal, capfd):
    make.photographs(photos, *ROWS)
    data = bytearray(make.png())
    data[data.index(b"IDAT") + 9] ^= 1
    (photos / "a.png").write_bytes(data)
    assert refusal() == "photos/a.png: is not a complete PNG or JPEG image"
    assert capfd.readouterr().err == ""


def progressive(side, scans):
    """A JPEG of one gray level, its last scan repeated: ten bytes of file for another pass over every pixel."""
    image = np.full((side, side), 200, np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last, have = data[data.rindex(b"\xff\xda") : -2], data.count(b"\xff\xda")
    return data[:-2] + last * (scans - have) + data[-2:]


def comment(data, text):
    """The same JPEG with a comment before its first scan."""
    at = data.index(b"\xff\xda")
    return data[:at] + b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text + data[at:]


def test_a_jpeg_that_goes_over_its_pixels_for_minutes_is_refused_by_its_header(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)
    monkeypatch.setattr(cv2, "imdecode", None)  # nothing is decoded
    (photos / "a.png").write_bytes(comment(progressive(64, 60_000), b"a comment that names an end \xff\xd9"))
    assert refusal() == "photos/a.png: JPEG of 64 x 64 pixels in more than 100 scans"
    monkeypatch.setattr(messages, "MAX_SCANNED_PIXELS", 64 * 64 * 20)
    (photos / "a.png").write_bytes(progressive(64, 21))
    assert refusal() == "photos/a.png: JPEG of 64 x 64 pixels in more than 20 scans"


def test_a_jpeg_with_a_film_behind_it_and_a_look_alike_of_scans_in_a_comment_is_imported(make, photos, run):
    make.photographs(photos, *ROWS)
    (photos / "a.png").write_bytes(comment(progressive(64, 12), b"\xff\xda" * 200) + b"\xff\xda film " * 2000)
    assert Recording(run()).strokes() == 2


def test_a_png_that_would_unpack_to_gigabytes_is_refused_by_its_header(make, photos, refusal, monkeypatch):
    make.photographs(photos, *ROWS)
    monkeypatch.setattr(cv2, "imdecode", None)
    header = struct.pack(">II5B", 60_000, 60_000, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(1000))), (b"IEND", b"")]
    data = [struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks]
    (photos / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(data))
    assert refusal() == "photos/a.png: image of 60000 x 60000 pixels exceeds 200000000"


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("depth_mm", "-13", "line 3, column `depth_mm`: '-13', allowed: 0 to 500"),
        ("depth_mm", "1e300", "line 3, column `depth_mm`: '1e300', allowed: 0 to 500"),
        ("tilt_deg", "-5", "line 3, column `tilt_deg`: '-5', allowed: 0 to 90"),
        ("depth_mid_cm", "-1.5", "line 3, column `depth_mid_cm`: '-1.5', allowed: 0 to 50"),
        ("bend_mm", "1e300", "line 3, column `bend_mm`: '1e300', allowed: -1e+06 to 1e+06"),
    ],
)
def test_a_depth_above_the_paper_or_out_of_this_world_is_refused(make, photos, refusal, column, value, message):
    first, second = ({**row, "depth_mid_cm": "1.5", "bend_mm": "0"} for row in ROWS)
    make.photographs(photos, first, {**second, column: value})
    assert refusal() == f"photos/table.csv: {message}"
