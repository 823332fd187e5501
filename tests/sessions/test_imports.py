"""Photographs from elsewhere become a session that reads like any other, or are refused in one line without a trace."""

import os
import shutil

import pytest

from brushloop.sessions import imports
from brushloop.sessions.errors import InputError
from brushloop.sessions.imports import ImportOptions
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Source
from tests.command import brushloop
from tests.sessions.conftest import no_space

START = {"start_x_px": "1", "start_y_px": "1"}
ROWS = [
    {"file": "a.png", "px_per_mm": "12.5", "depth_mm": "13", "tilt_deg": "5"} | START,
    {"file": "b.png", "px_per_mm": "12.5", "depth_mm": "15", "tilt_deg": "10"} | START,
]
HEAD = "file,px_per_mm,start_x_px,start_y_px,depth_mm,tilt_deg"


@pytest.fixture
def rows(make, photos):
    """The table and the photographs of two presses."""
    return make.photographs(photos, *ROWS)


@pytest.fixture
def refusal(make, tmp_path, run):
    """Runs the import; it is refused in one line with exit code 2, and nothing is left behind."""

    def refusal(*options):
        before = make.tree(tmp_path)
        with pytest.raises(InputError) as caught:
            run(*options)
        assert make.tree(tmp_path) == before
        assert caught.value.exit_code == 2
        line = str(caught.value).removeprefix(f"{tmp_path}/")
        assert "\n" not in line
        assert len(line) < 400
        return line

    return refusal


def test_presses_become_a_session_like_any_other(make, rows, out, run):
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


@pytest.mark.parametrize(
    ("options", "fields"),
    [
        ({"brush_radius_mm": 4.0, "brush_length_mm": 31.0}, {"brush_radius_mm": 4.0, "brush_length_mm": 31.0}),
        ({"simulated": True}, {"source": Source.IMPORT_SIMULATED}),
        ({}, {"origin": "photos, table.csv", "source": Source.IMPORT, "brush_radius_mm": 6.0}),
    ],
)
def test_the_header_holds_what_was_given(rows, out, run, options, fields):
    run(ImportOptions(kind="press", **options))
    assert Recording(out).header.model_dump(include=set(fields)) == fields


def test_columns_without_a_field_of_their_own_are_kept_under_their_names(make, photos, out, run):
    others = {"depth_nominal": "0.4", "ink_frac": "0.9", "reach_mm": "2", "yaw_deg": "7"}
    make.photographs(photos, {"file": "a.png", "start_x_px": "3", "start_y_px": "4.5"} | others)
    run(ImportOptions("drag", px_per_mm=8.0))
    [capture] = Recording(out).captures()
    assert capture.stroke.anchor_px == (3.0, 4.5)
    assert capture.stroke.px_per_mm == (8.0, 8.0)
    assert capture.stroke.commanded == {name: float(value) for name, value in others.items()}


def test_a_table_may_come_from_a_spreadsheet(make, photos, out, run):
    """Byte order mark, CRLF, quotes, an empty last line, photographs in sub-folders, one scale per axis."""
    (photos / "day 1").mkdir(parents=True)
    shutil.copy(make.photographs(photos, ROWS[0]).with_name("a.png"), photos / "day 1" / "ä, 1.png")
    text = '\ufefffile, px_per_mm_x ,px_per_mm_y\r\n"day 1/ä, 1.png",10,20\r\n,,\r\n\r\n'
    (photos / "table.csv").write_text(text, encoding="utf-8", newline="")
    run(ImportOptions("drag"))
    [capture] = Recording(out).captures()
    assert capture.stroke.stroke_id == "day 1/ä, 1"
    assert capture.stroke.px_per_mm == (10.0, 20.0)


def test_a_depth_may_be_called_a_height_as_the_shared_photographs_of_presses_do(make, photos, out, run):
    row = {"file": "a.png", "px_per_mm": "12.5", "height_mm": "13", "tilt_deg": "5"} | START
    make.photographs(photos, row)
    run()
    [capture] = Recording(out).captures()
    assert (capture.stroke.depth_mm, capture.stroke.commanded) == (13.0, {})


def test_what_a_killed_import_left_is_cleared_away(rows, out, run):
    stage = out.with_name(".from-elsewhere.partial")
    stage.mkdir(parents=True)
    (stage / "from-elsewhere.mcap.part").write_bytes(b"half")
    run()
    assert not stage.exists()


def row(file="a.png", scale="1", depth="1", tilt="1", more=""):
    """The line of one press, and the head before it."""
    return f"{HEAD}\n{file},{scale},1,1,{depth},{tilt}{more}\n"


REFUSED = [
    ("", "table.csv: line 1: column `file` is missing; found: none"),
    (HEAD, "has no rows"),
    ("file,depth_mm,tilt_deg", "column `px_per_mm` (or px_per_mm_x and px_per_mm_y) is missing"),
    ("file,px_per_mm,depth_mm,tilt_deg", "column `start_x_px` is missing"),
    (f"{HEAD},l_mm,l_mm", "column `l_mm` occurs twice"),
    ('"fi\nle",px_per_mm', "line 2: 'fi\\nle' holds control characters"),
    (row(depth="deep"), "line 2: column `depth_mm`: 'deep' is not a finite"),
    (row(scale="inf"), "line 2: column `px_per_mm`: 'inf' is not a finite"),
    (row(scale="0"), "line 2: column `px_per_mm`: 0.0, input should be greater than or equal to 0.01"),
    (row(depth="-13"), "line 2: column `depth_mm`: -13.0, input should be greater than or equal to 0"),
    (f"{HEAD}\na.png,1,1,1,1", "line 2: 5 fields, expected 6"),
    (row(more="\u2028,1"), "line 2: 7 fields"),
    (row(more="\n\n./a.png,1,1,1,1,1"), "line 4: stroke a appears twice"),
    (row("c.png"), "line 2: file 'c.png' is not in photos/"),
    (row("../x.png"), "line 2: file '../x.png' is not in photos/"),
    (row("/x.png"), "line 2: file '/x.png' is not in photos/"),
    (row("link.png"), "line 2: file 'link.png' is not in photos/"),
    (row('"a\n.png"'), "line 3: 'a\\n.png' holds control"),
    (row('"a.png"x'), "line 2: ',' expected after '\"'"),
    (row("cut.png"), "photos/cut.png: is not a complete PNG or JPEG image"),
    (row().replace("1,1,1,1\n", "900,1,1,1\n"), "photos/a.png: its 24 x 24 pixels do not show (start_x_px"),
    ("file,größe_mm\n".encode("latin-1"), "photos/table.csv: is not UTF-8 text"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED, ids=[message for _text, message in REFUSED])
def test_a_table_that_cannot_be_used_is_refused(make, tmp_path, photos, rows, refusal, text, message):
    (tmp_path / "x.png").write_bytes(make.png())
    (photos / "link.png").symlink_to(tmp_path / "x.png")
    (photos / "cut.png").write_bytes(make.png()[:-20])
    rows.write_bytes(text if isinstance(text, bytes) else text.encode())
    assert message in refusal()


@pytest.mark.parametrize("option", ["--kind=stamp", "--kind=", "--px-per-mm=0", "--px-per-mm=1e9", "--px-per-mm=nan"])
def test_an_unknown_kind_and_a_scale_that_no_camera_has_are_refused(rows, photos, out, option):
    ran = brushloop("sessions", "import", photos, "--csv", photos / "table.csv", "--out", out, option)
    assert (ran.returncode, option[2:6] in ran.stderr, out.exists()) == (2, True, False), ran.stderr


@pytest.mark.parametrize(("limit", "file"), [("MAX_TABLE_BYTES", "table.csv"), ("MAX_IMAGE_BYTES", "a.png")])
def test_what_is_too_large_is_refused(rows, refusal, monkeypatch, limit, file):
    monkeypatch.setattr(imports, limit, 10)
    assert f"photos/{file}: is larger than 10 bytes" in refusal()


def test_without_folder_or_table_and_where_a_session_is_nothing_is_imported(make, photos, out, refusal):
    assert refusal() == "photos: is not a folder of photographs"
    photos.mkdir()
    assert refusal() == "photos/table.csv: no such file"
    make.photographs(photos, *ROWS)
    out.mkdir(parents=True)
    assert "exists already" in refusal()


@pytest.mark.parametrize("call", ["mkdir", "fsync"])
def test_a_disk_without_room_is_refused(rows, photos, refusal, monkeypatch, call):
    (photos.parent / "sessions").mkdir()

    monkeypatch.setattr(os, call, no_space)
    assert refusal() == "sessions/from-elsewhere: cannot write: No space left on device"
