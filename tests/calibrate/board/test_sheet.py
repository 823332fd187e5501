"""Presses made by hand: the printed sheet is found in its scan, each box is read, and what does not agree is named."""

from __future__ import annotations

import functools
import io
import math
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.board.sheet import INSET_MM, PAGES, TOUCH_MM, Layout, drawn_sheet, find_sheet, print_sheet
from brushloop.calibrate.commands import ImportRequest, SheetRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.imports import import_session
from brushloop.calibrate.presses import prepare_press
from brushloop.calibrate.stroke.preprocess import measure
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_models
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Source
from tests.command import refused, said

DPI = 400
PX_PER_MM = DPI / 25.4
A4 = Layout("a4")
TABLE = "box,depth_mm,tilt_deg\nA1,11,0\nB2,15,5\nD5,20,10\nG8,13,0\n"


@functools.cache
def _printed() -> np.ndarray:
    """The sheet as a printer without an error of scale prints it, (h, w) gray."""
    file = io.BytesIO()
    drawn_sheet(A4).savefig(file, dpi=DPI, format="png")
    return cv2.imdecode(np.frombuffer(file.getvalue(), np.uint8), cv2.IMREAD_GRAYSCALE)


@dataclass(frozen=True, slots=True)
class Scanned:
    """How a sheet was printed, inked and scanned."""

    pressed: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Depth and tilt of the press in each box."""
    print_scale: tuple[float, float] = (1.004, 0.997)
    """Millimetres of the print for each millimetre of the drawing."""
    scan_scale: tuple[float, float] = (1.003, 0.998)
    """Error of the scanner's resolution, across and along."""
    skew_deg: float = 1.3
    torn: tuple[int, ...] = ()
    """Marks that are torn off."""
    stained: tuple[str, ...] = ()
    """Boxes on which a cup stood."""

    @property
    def measured_mm(self) -> tuple[float, float]:
        """What a ruler shows between the outer edges of the marks."""
        across, along = A4.printed_mm
        return across * self.print_scale[0], along * self.print_scale[1]

    def image(self) -> np.ndarray:
        """The scan, (h, w) gray, at about 400 dpi."""
        drawn = _printed().copy()
        for number in self.torn:
            (left, top), (right, bottom) = (A4.marks()[number][[0, 2]] * PX_PER_MM).round().astype(int).tolist()
            drawn[top:bottom, left:right] = 255
        (across, along), (tall, wide) = self.print_scale, drawn.shape
        size = round(wide * across), round(tall * along)
        sheet = 0.94 * cv2.resize(drawn, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for box, condition in self.pressed.items():
            self._press(sheet, box, *condition)
        for box in self.stained:
            x, y = self._touch_px(box)
            ring, centre = np.ones_like(sheet), (round(x - 8 * PX_PER_MM), round(y))
            cv2.circle(ring, centre, round(35 * PX_PER_MM), (0.75,), round(4 * PX_PER_MM))
            sheet *= cv2.blur(ring, (21, 21))
        turn = math.radians(self.skew_deg)
        scale = np.diag(self.scan_scale)
        move = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) @ scale
        size = (round(wide * 1.05), round(tall * 1.06))
        affine = np.column_stack([move, [90.0, 40.0]])
        scan = cv2.warpAffine(sheet, affine, size, flags=cv2.INTER_CUBIC, borderValue=(200.0,))
        noise = np.random.default_rng(3).normal(0.0, 2.0, (256, scan.shape[1])).astype(np.float32)
        noise = np.resize(noise, scan.shape)
        return np.clip(scan + noise, 0, 255).astype(np.uint8)

    def _touch_px(self, box: str) -> tuple[float, float]:
        x, y, wide, tall = A4.boxes()[box]
        return (x + wide - 8.5) * self.print_scale[0] * PX_PER_MM, (y + 0.5 * tall) * self.print_scale[1] * PX_PER_MM

    def _press(self, sheet: np.ndarray, box: str, depth_mm: float, tilt_deg: float) -> None:
        """Ink the mark of a press on the print."""
        x, y = self._touch_px(box)
        left, top, size = round(x) - 500, round(y) - 350, 700
        mark = stroke_models(Brush())["ccd-bsm"].profile(depth_mm, tilt_deg)
        origin_mm = np.array(
            [(x - left) / PX_PER_MM + depth_mm * math.tan(math.radians(tilt_deg)), (y - top) / PX_PER_MM]
        )
        ink = coverage(mark, origin_mm, size_px=size, px_mm=1.0 / PX_PER_MM)[0]
        part = sheet[max(top, 0) : top + size, max(left, 0) : left + size]
        rows, columns = part.shape
        part *= 1.0 - 0.85 * ink[max(-top, 0) :, max(-left, 0) :][:rows, :columns]


@pytest.mark.parametrize(
    ("scanned", "turned"),
    [
        (Scanned(), False),
        (Scanned(torn=(0,), stained=("C3",)), False),
        (Scanned(torn=(4, 7, 9), print_scale=(1.0, 1.0), scan_scale=(0.99, 1.01)), True),
        (Scanned(skew_deg=-0.3, torn=(1, 2, 3)), False),
    ],
    ids=["all marks", "a mark torn off and a stain", "upside down", "only the corners of a row"],
)
def test_the_scale_of_a_scan_is_known_within_a_fifth_of_a_percent(scanned, turned):
    image = cv2.rotate(scanned.image(), cv2.ROTATE_180) if turned else scanned.image()
    scan = find_sheet(image, "scan.png", scanned.measured_mm)
    truth = [PX_PER_MM * scale for scale in scanned.scan_scale]
    assert scan.px_per_mm == pytest.approx(truth, rel=0.002)
    assert scan.missing == len(scanned.torn)
    assert scan.residual_mm < 0.05


@pytest.fixture
def table(tmp_path) -> Path:
    """What the person says to have pressed: B2 was pressed in B3 by mistake."""
    path = tmp_path / "sheet.csv"
    path.write_text(TABLE)
    return path


def test_every_press_of_a_stained_and_torn_sheet_is_found_or_named(tmp_path, table):
    pressed = {"A1": (11, 0), "B3": (15, 5), "D5": (20, 10), "G8": (13, 0)}
    scanned = Scanned(pressed, torn=(2,), stained=("D5", "F2"))
    scan, out = tmp_path / "scan.png", tmp_path / "by-hand"
    cv2.imwrite(str(scan), scanned.image())
    request = ImportRequest(scan, table, out, measured_mm=scanned.measured_mm, simulated=True)
    written = import_session(request)
    assert written.left_out == [
        ("B2", "is blank, but the table has a row for it"),
        ("B3", "holds ink, but the table has no row for it"),
    ]
    recording = Recording(out)
    assert (recording.header.source, recording.header.origin) == (Source.IMPORT_SIMULATED, "scan.png, sheet.csv")
    strokes = {capture.stroke.stroke_id: capture for capture in recording.captures()}
    assert list(strokes) == ["A1", "B2", "D5", "G8"]
    for box in ("A1", "D5", "G8"):
        mark = stroke_models(Brush())["ccd-bsm"].profile(*map(float, pressed[box]))
        prepared = prepare_press(strokes[box], None)
        assert measure(prepared.mask).length_mm == pytest.approx(float(mark.x_max_mm[0] - mark.x_min_mm[0]), abs=0.15)
        assert not prepared.cut
        # It lies where it was pressed: the brush's axis meets the paper H tan(alpha) to the right of the touch.
        to_right_mm = float(mark.x_max_mm[0]) + pressed[box][0] * math.tan(math.radians(pressed[box][1]))
        right_px = np.flatnonzero(prepared.mask.any(axis=0))[-1] + 1 - prepared.anchor_px[0]
        assert right_px / 20.0 == pytest.approx(to_right_mm, abs=0.15)


def test_a_command_names_the_boxes_that_do_not_agree_and_ends_with_code_3(tmp_path, table):
    scan = tmp_path / "scan.png"
    cv2.imwrite(str(scan), Scanned({"A1": (11, 0), "D5": (20, 10), "G8": (13, 0)}).image())
    printed = said("sessions", "import", scan, "--csv", table, "--out", tmp_path / "by-hand", left_out=True)
    assert "Box B2 is blank, but the table has a row for it" in printed
    assert "measure it and give --measured-mm" in printed


@pytest.mark.parametrize(
    ("change", "measured_mm", "message"),
    [
        (lambda image: np.full_like(image, 230), None, "shows 0 of the sheet's 10 marks"),
        (lambda image: image[:, ::-1].copy(), None, "scan the whole sheet, not mirrored"),
        (lambda image: image[: len(image) // 2].copy(), None, "some of them in each row"),
        (lambda image: cv2.resize(image, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA), None, "159 dpi; 200 are"),
        (lambda image: _photographed(image), None, "lay the sheet flat on a scanner"),
        (lambda image: image, (28.1, 198.0), "--measured-mm: across: 28.1 mm, allowed 276.4 to 293.6"),
        (lambda image: image, (285.0, math.nan), "--measured-mm: along: nan mm, allowed"),
    ],
    ids=["another page", "mirrored", "half of it", "coarse", "a photograph", "centimetres", "no number"],
)
def test_what_is_no_scan_of_a_sheet_is_refused_in_one_line(blank_scan, change, measured_mm, message):
    with pytest.raises(CalibrationError, match=message.replace("(", r"\(")):
        find_sheet(change(blank_scan), "scan.png", measured_mm)


@pytest.fixture(scope="module")
def blank_scan() -> np.ndarray:
    """The scan of a sheet without a press. Nobody changes it."""
    return Scanned(skew_deg=0.4).image()


def _photographed(image: np.ndarray) -> np.ndarray:
    """The picture of a camera that was not held straight above."""
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    seen = corners + np.array([[150, 90], [-100, 0], [0, 0], [0, 0]], np.float32)
    return cv2.warpPerspective(image, cv2.getPerspectiveTransform(corners, seen), (width, height))


@pytest.mark.parametrize("page", PAGES)
def test_the_sheet_and_its_table_are_written_once_for_each_size_of_page(tmp_path, page):
    request = SheetRequest(tmp_path / "sheet.pdf", page)
    print_sheet(request)
    lines = (tmp_path / "sheet.csv").read_text().splitlines()
    assert (lines[0], lines[1], len(lines)) == ("box,depth_mm,tilt_deg", "A1,11,0", 61)
    with pytest.raises(CalibrationError, match="exists already and is not overwritten"):
        print_sheet(request)
    layout = Layout(page)
    assert len(layout.boxes()) == 64
    # Every planned press of the paper's brush fits its box, with a millimetre to spare for the hand.
    (wide, tall), model = layout.box_mm, stroke_models(Brush())["ccd-bsm"]
    for depth, tilt in layout.planned().values():
        mark, lean_mm = model.profile(float(depth), float(tilt)), depth * math.tan(math.radians(tilt))
        assert -float(mark.x_min_mm[0]) - lean_mm < wide - TOUCH_MM - INSET_MM - 1.0
        assert float(mark.x_max_mm[0]) + lean_mm < TOUCH_MM - INSET_MM - 1.0
        assert float(np.abs(mark.points[..., 1]).max()) < 0.5 * tall - INSET_MM - 1.0


def test_a_table_of_boxes_needs_a_scan_and_a_page_must_be_known(tmp_path, table):
    with pytest.raises(CalibrationError, match="page 'a5': is not one of a4, letter, a3"):
        print_sheet(SheetRequest(tmp_path / "x.pdf", "a5"))
    line = refused("sessions", "import", tmp_path, "--csv", table, "--out", tmp_path / "x")
    assert "column `file` is missing" in line
    scan = tmp_path / "scan.png"
    cv2.imwrite(str(scan), Scanned().image())
    table.write_text("box,depth_mm,tilt_deg\nK1,11,0\n")
    line = refused("sessions", "import", scan, "--csv", table, "--out", tmp_path / "x")
    assert line.endswith("sheet.csv: line 2: box 'K1' is not in scan.png/")
    assert not (tmp_path / "x").exists()
