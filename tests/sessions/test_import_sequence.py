"""A page photographed after every stroke becomes a session, and so do scans."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sessions.cli import app
from sessions.errors import InputError
from sessions.imports.photographs import ImportOptions, dpi_of, import_scans
from sessions.imports.sequence import SEQUENCE, import_sequence
from sessions.reader import Recording
from sessions.recording.schemas import Topic


@pytest.fixture
def page(tmp_path: Path) -> Path:
    """Four frames of 80 x 60 px; frame k shows k strokes."""
    folder = tmp_path / "page"
    folder.mkdir()
    image = np.full((60, 80), 240, np.uint8)
    for k in range(4):
        if k:
            cv2.line(image, (10, 12 * k), (60, 12 * k), 20, 4)
        cv2.imwrite(str(folder / f"f{k}.png"), image)
    (folder / "strokes.csv").write_text(
        "before,after,start_x_px,start_y_px,depth_mm\nf0.png,f1.png,10,12,1\nf1.png,f2.png,10,24,2\nf2.png,f3.png,10,36,3\n"
    )
    return folder


def run(page: Path, make, *, table: bool = True, options: ImportOptions | None = None, page_mm=(160.0, 120.0)) -> Path:
    out = page.parent / "sessions" / "page"
    csv = page / "strokes.csv" if table else None
    return import_sequence(page, csv, out, options or ImportOptions(), "brushloop 0", make.clock(), page_mm)


def test_every_frame_is_a_still_and_every_stroke_names_the_one_after_it(page: Path, make) -> None:
    recording = Recording(run(page, make))
    captures = list(recording.captures())
    assert [capture.stroke.still for capture in captures] == [1, 2, 3]
    assert [capture.stroke.stroke_id for capture in captures] == ["f1", "f2", "f3"]
    assert captures[1].still_png == (page / "f2.png").read_bytes()
    assert captures[2].stroke.px_per_mm == (0.5, 0.5)
    assert captures[2].stroke.anchor_px == (10.0, 36.0)
    assert captures[2].stroke.commanded == {"depth_mm": 3.0}
    assert recording.header.protocol.startswith(SEQUENCE)
    assert sum(topic == Topic.STILL for topic, *_ in make.messages(recording.path)) == 4


def test_without_a_table_the_frames_are_taken_by_name(page: Path, make) -> None:
    captures = list(Recording(run(page, make, table=False)).captures())
    assert [capture.stroke.stroke_id for capture in captures] == ["f1", "f2", "f3"]
    assert captures[0].stroke.anchor_px is None


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("before,file\nf0.png,f1.png\n", "column `after` is missing; found: before, file"),
        ("before,after\n", "has no rows"),
        (
            "before,after\nf0.png,f1.png\nf0.png,f2.png\n",
            "line 3: `before` is 'f0.png', the frame before it is 'f1.png'",
        ),
        ("before,after\nf9.png,f1.png\n", "frame 'f9.png' is not in page/"),
        ("before,after\nf0.png,f9.png\n", "file 'f9.png' is not in page/"),
        ("before,after\nf0.png,small.png\n", "is 8 x 8 px, the first frame 80 x 60"),
        ("before,after\nf0.png\n", "line 2 has 1 fields, expected 2"),
    ],
)
def test_a_chain_that_is_none_is_refused_and_nothing_is_left(page: Path, make, table: str, message: str) -> None:
    cv2.imwrite(str(page / "small.png"), np.full((8, 8), 200, np.uint8))
    (page / "strokes.csv").write_text(table)
    with pytest.raises(InputError) as refused:
        run(page, make)
    assert message in str(refused.value)
    assert not (page.parent / "sessions").exists()


def test_without_any_scale_it_is_refused(page: Path, make) -> None:
    with pytest.raises(InputError, match="px_per_mm"):
        run(page, make, page_mm=None)


def test_the_commands_import(page: Path) -> None:
    out = page.parent / "s" / "page"
    arguments = [
        "import-sequence",
        str(page),
        "--csv",
        str(page / "strokes.csv"),
        "--page-mm",
        "160x120",
        "--out",
        str(out),
    ]
    ran = CliRunner().invoke(app, arguments)
    assert (ran.exit_code, ran.output) == (0, f"Imported into {out / 'page.mcap'}\n")
    bad = CliRunner().invoke(app, [*arguments[:-3], "wide", "--out", str(out)])
    assert "expected a size like 203.2x279.4" in str(bad.exception)


def with_dpi(path: Path, image: np.ndarray, dpi: float) -> None:
    """A PNG that states its resolution (chunk pHYs)."""
    data = cv2.imencode(".png", image)[1].tobytes()
    body = b"pHYs" + struct.pack(">IIB", round(dpi / 0.0254), round(dpi / 0.0254), 1)
    path.write_bytes(data[:33] + struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body)) + data[33:])


def test_a_sheet_of_scanned_strokes_is_cut_up_at_the_scanners_own_scale(tmp_path: Path, make) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    sheet = np.arange(200 * 300, dtype=np.uint32).reshape(200, 300).astype(np.uint8)
    with_dpi(folder / "sheet.png", sheet, 400)
    (folder / "t.csv").write_text(
        "file,name,left_px,top_px,width_px,height_px\nsheet.png,01,0,0,100,80\nsheet.png,02,150,40,120,90\n"
    )
    out = tmp_path / "sessions" / "scans"
    path = import_scans(folder, folder / "t.csv", out, ImportOptions(), "brushloop 0", make.clock())
    first, second = Recording(path).captures()
    assert first.stroke.px_per_mm == pytest.approx((15.748, 15.748), rel=1e-4)
    assert second.stroke.stroke_id == "02"
    assert (second.image() == sheet[40:130, 150:270]).all()


def test_scans_that_cannot_be_cut_or_scaled_are_refused(tmp_path: Path, make) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((50, 50), 200, np.uint8))
    table, out = folder / "t.csv", tmp_path / "sessions" / "scans"

    def refusal(text: str, dpi: float | None = None) -> str:
        table.write_text(text)
        with pytest.raises(InputError) as refused:
            import_scans(folder, table, out, ImportOptions(), "brushloop 0", make.clock(), dpi)
        assert not out.parent.exists()
        return str(refused.value)

    assert "does not say its dpi; give --dpi" in refusal("file\na.png\n")
    assert "allowed 20 to 10000" in refusal("file\na.png\n", 3.0)
    assert "needs all of left_px" in refusal("file,name,left_px\na.png,x,1\n", 300.0)
    box = "file,name,left_px,top_px,width_px,height_px\na.png,x,40,0,20,20\n"
    assert "stroke x: the box 40, 0, 20, 20 is not within 50 x 50 px" in refusal(box, 300.0)
    assert "the scale of a scan is its dpi" in refusal("file,px_per_mm\na.png,3\n", 300.0)


def test_the_resolution_of_jpegs_is_read_too() -> None:
    jfif = bytes.fromhex("ffd8ffe000104a46494600010101012c012c0000")
    assert dpi_of(jfif) == (300.0, 300.0)
    assert dpi_of(jfif[:13] + b"\x02" + jfif[14:]) == pytest.approx((762.0, 762.0))
    assert dpi_of(jfif[:13] + b"\x00" + jfif[14:]) is None
