"""A printed sheet for presses made by hand: marks, numbered boxes, and how a scan of it is read.

The sheet has `ROWS` rows of boxes, `COLUMNS` in each, between two rows of marks. A scanner keeps straight lines
straight, so the marks give an affine map from millimetres to the pixels of the scan, whatever its skew and its scale.
Lengths on the print may differ from the drawing: the person measures the print, and the map is in the print's
millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, Gray
from brushloop.calibrate.board.spec import MM_PER_INCH, PAGES_MM, Rectangle, check_pdf
from brushloop.calibrate.commands import SheetRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written, write_whole
from brushloop.sessions.disk import replacing
from brushloop.sessions.terminal import Progress, unseen

ROWS, COLUMNS = "ABCDEFGH", 8
EDGE_MM, STRIP_MM, LABEL_MM = 6.0, 12.0, 2.5
"""Unprinted edge of the page; height of the rows of marks, and of the line above each box that has its number."""
MARK_MM, MARKS = 10.0, 5
"""Side of a mark, and the number of marks in each of the two rows."""
DICTIONARY = cv2.aruco.DICT_4X4_50
TOUCH_MM = 8.5
"""From a box's right edge to its touch point, at half of its height: marks extend to the left."""
INSET_MM = 0.3
"""Width of the strip along the edges of a box that is not read, because the edges are printed there."""
PAGES = ("a4", "letter", "a3")
"""Each page has marks of its own numbers, so that a scan tells which page it shows."""
DEPTHS_MM, TILTS_DEG, REPEATS = (11, 13, 15, 17, 20), (0, 5, 10), 4
MOST_DRIFT = 0.03
"""Largest difference between a measured length and the drawing, as a share: more is another length or another unit."""
LEAST_PX_PER_MM = 7.8
"""A scan of 200 dpi."""
MOST_RESIDUAL_MM = 0.2
"""Largest root mean square distance of the marks from an affine map: more is a photograph, or a fold."""
ASTRAY_MM = 1.0
"""Distance above which a mark is left out."""
INK_DARKER, INK_MM2 = 0.5, 4.0
"""A box with at least this area that is darker than this share of its paper holds ink: a pale stain does not count."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The sheet on a page, in mm, x right and y down from the page's upper left corner."""

    page: str

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the page, which lies on its longer side."""
        return PAGES_MM[self.page][1], PAGES_MM[self.page][0]

    @property
    def printed_mm(self) -> tuple[float, float]:
        """Width and height between the outer edges of the marks: what the person measures."""
        width, height = self.size_mm
        return width - 2.0 * EDGE_MM, height - 2.0 * EDGE_MM

    @property
    def box_mm(self) -> tuple[float, float]:
        """Width and height of a box."""
        width, height = self.printed_mm
        return width / COLUMNS, (height - 2.0 * STRIP_MM) / len(ROWS) - LABEL_MM

    def marks(self) -> dict[int, Floats]:
        """Each mark's number and its (4, 2) corners, in OpenCV's order."""
        (width, height), first = self.printed_mm, 2 * MARKS * PAGES.index(self.page)
        corners = np.array([[0.0, 0.0], [MARK_MM, 0.0], [MARK_MM, MARK_MM], [0.0, MARK_MM]]) + EDGE_MM
        step = (width - MARK_MM) / (MARKS - 1)
        places = [(step * k, y) for y in (0.0, height - MARK_MM) for k in range(MARKS)]
        return {first + number: corners + np.array(place) for number, place in enumerate(places)}

    def boxes(self) -> dict[str, Rectangle]:
        """Each box's name, such as A1, and its x, y, width and height, without the line that has its number."""
        wide, tall = self.box_mm
        top = EDGE_MM + STRIP_MM + LABEL_MM
        return {
            f"{name}{column + 1}": (EDGE_MM + wide * column, top + (tall + LABEL_MM) * row, wide, tall)
            for (row, name), column in product(enumerate(ROWS), range(COLUMNS))
        }

    def planned(self) -> dict[str, tuple[int, int]]:
        """What to press: depth in mm and tilt in degrees for each box but the last ones, which are spare."""
        conditions = list(product(DEPTHS_MM, TILTS_DEG)) * REPEATS
        return dict(zip(self.boxes(), conditions, strict=False))


def print_sheet(request: SheetRequest, _progress: Progress = unseen) -> Written:
    """Write the sheet as a PDF at true scale, and beside it the table to fill in.

    Raises `CalibrationError` for another page, or where the PDF or the table exists.
    """
    path, table = request.out, request.out.with_suffix(".csv")
    if request.page not in PAGES:
        raise CalibrationError(f"page {request.page!r}", f"is not one of {', '.join(PAGES)}")
    check_pdf(path)
    for target in (path, table):
        if target.exists():
            raise CalibrationError(str(target), "exists already and is not overwritten")
    layout = Layout(request.page)
    rows = [f"{box},{depth},{tilt}" for box, (depth, tilt) in layout.planned().items()]
    with replacing(path) as part:
        drawn_sheet(layout).savefig(part, format="pdf", metadata={"CreationDate": None})
    write_whole(table, "\n".join(["box,depth_mm,tilt_deg", *rows, ""]))
    across, along = layout.printed_mm
    said = (
        f"{path}: {len(layout.boxes())} boxes. Print at 100 %.",
        f"{table}: what to press in each box. Change it to what you pressed, and remove the rows of boxes left blank.",
        f"Measure the print between the outer edges of its marks: {across:g} mm across and {along:g} mm along if the "
        "printer is exact.",
    )
    return Written(path, said)


def drawn_sheet(layout: Layout) -> Any:
    """The page as a matplotlib figure."""
    from matplotlib.figure import Figure

    width, height = layout.size_mm
    figure: Any = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, width), ylim=(height, 0.0))
    axes.axis("off")
    for number, corners in layout.marks().items():
        (left, top), (right, bottom) = corners[0], corners[2]
        bits = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(DICTIONARY), number, 6)
        axes.imshow(bits, cmap="gray", extent=(left, right, bottom, top), interpolation="nearest", aspect="auto")
    planned, small = layout.planned(), {"fontsize": 6.0, "va": "bottom"}
    for name, (x, y, wide, tall) in layout.boxes().items():
        axes.plot([x, x + wide, x + wide, x, x], [y, y, y + tall, y + tall, y], color="0.7", linewidth=0.4)
        right, middle = x + wide - TOUCH_MM, y + 0.5 * tall
        cross = [right - 1.5, right + 1.5], [middle, middle], [right, right], [middle - 1.5, middle + 1.5]
        axes.plot(*cross, color="0.85", linewidth=0.3)
        depth, tilt = planned.get(name, ("", ""))
        axes.text(x + 0.5, y - 0.4, f"{name}   H {depth} mm, tilt {tilt} deg" if depth else f"{name}   spare", **small)
    across, along = layout.printed_mm
    words = (
        f"Printed at 100 %, outer edges of marks:\n{across:g} mm across, {along:g} mm along",
        "Tip on the cross, brush upright;\nlean its upper end to the right, then press",
    )
    for column, text in enumerate(words):
        left = EDGE_MM + (across - MARK_MM) / (MARKS - 1) * column + MARK_MM
        axes.text(left + 3.0, height - EDGE_MM - 2.0, text, **small)
    return figure


@dataclass(frozen=True, slots=True)
class SheetScan:
    """A scan in which the sheet's marks were found."""

    layout: Layout
    image: Gray
    to_px: Floats
    """(2, 3) affine map from mm on the drawing to pixels, with pixel centres on integers."""
    stretch: tuple[float, float]
    """Millimetres of the print for each millimetre of the drawing, across and along."""
    residual_mm: float
    missing: int
    """How many marks were not found, or lie astray."""

    @property
    def px_per_mm(self) -> tuple[float, float]:
        """Scale of the scan across and along the sheet, in pixels for a millimetre of the print."""
        across, along = np.linalg.norm(self.to_px[:, :2], axis=0) / np.array(self.stretch)
        return float(across), float(along)

    def start_px(self, px_per_mm: float) -> tuple[float, float]:
        """The touch point in the picture of each box."""
        (wide, tall), (across, along) = self.layout.box_mm, self.stretch
        x, y = wide - TOUCH_MM - INSET_MM, 0.5 * tall - INSET_MM
        return x * across * px_per_mm, y * along * px_per_mm

    def picture(self, box: Rectangle, px_per_mm: float) -> Gray:
        """The inside of a box at this scale of the print, straightened."""
        x, y, wide, tall = box
        step = np.array([1.0 / (px_per_mm * side) for side in self.stretch])
        size = [int((side - 2.0 * INSET_MM) / each) for side, each in zip((wide, tall), step, strict=True)]
        corner = np.array([x + INSET_MM, y + INSET_MM]) + 0.5 * step
        move = np.column_stack([self.to_px[:, :2] * step, self.to_px @ np.array([*corner, 1.0])])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpAffine(self.image, move, (size[0], size[1]), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return cast("Gray", warped)


def find_sheet(image: Gray, where: str, measured_mm: tuple[float, float] | None) -> SheetScan:
    """Find the sheet in a scan, in any orientation. `measured_mm` is what the person measured, across and along.

    Raises `CalibrationError`, which says what is wrong.
    """
    seen = _marks_in(image)
    layout = max(map(Layout, PAGES), key=lambda page: len(seen.keys() & page.marks().keys()))
    marks = {number: place for number, place in layout.marks().items() if number in seen}
    if len(marks) < 4 or len({number // MARKS for number in marks}) < 2:
        why = f"shows {len(marks)} of the sheet's {2 * MARKS} marks; four are needed, some of them in each row"
        raise CalibrationError(where, why + ": scan the whole sheet, not mirrored, at 400 dpi")
    drawn_mm, pixels = np.concatenate(list(marks.values())), np.concatenate([seen[number] for number in marks])
    scale = float(np.linalg.norm(np.ptp(pixels, axis=0)) / np.linalg.norm(np.ptp(drawn_mm, axis=0)))
    fitted, inside = cv2.estimateAffine2D(drawn_mm, pixels, ransacReprojThreshold=ASTRAY_MM * scale)
    to_px: Floats = np.asarray(fitted, np.float64)
    used = cast("NDArray[np.uint8]", inside).ravel() > 0
    off_px: Floats = (drawn_mm @ to_px[:, :2].T + to_px[:, 2] - pixels)[used]
    residual_mm = float(np.sqrt(2.0 * np.mean(np.square(off_px)))) / scale
    astray = sum(not all(four) for four in used.reshape(-1, 4).tolist())
    missing = 2 * MARKS - len(marks) + astray
    scan = SheetScan(layout, image, to_px, _stretch(layout, measured_mm), residual_mm, missing)
    if (least := min(scan.px_per_mm)) < LEAST_PX_PER_MM:
        raise CalibrationError(where, f"has {least * MM_PER_INCH:.0f} dpi; 200 are needed, 400 are better")
    if residual_mm > MOST_RESIDUAL_MM or 4 * astray > len(marks):
        why = f"its marks lie {residual_mm:.2f} mm from where a flat scan would show them"
        raise CalibrationError(where, f"{why}: lay the sheet flat on a scanner, and do not photograph it")
    return scan


def holds_ink(picture: Gray, px_per_mm: float) -> bool:
    """Whether the picture of a box shows ink."""
    dark = picture < INK_DARKER * float(np.percentile(picture, 90))
    return float(np.count_nonzero(dark)) >= INK_MM2 * px_per_mm**2


def _stretch(layout: Layout, measured_mm: tuple[float, float] | None) -> tuple[float, float]:
    across, along = layout.printed_mm
    stretch = (1.0, 1.0) if measured_mm is None else (measured_mm[0] / across, measured_mm[1] / along)
    for axis, value, drawn in zip(("across", "along"), stretch, layout.printed_mm, strict=True):
        if not abs(value - 1.0) <= MOST_DRIFT:  # NaN too
            allowed = f"{(1 - MOST_DRIFT) * drawn:.1f} to {(1 + MOST_DRIFT) * drawn:.1f}"
            raise CalibrationError("--measured-mm", f"{axis}: {value * drawn:g} mm, allowed {allowed}")
    return stretch


def _marks_in(image: Gray) -> dict[int, Floats]:
    """The number and the (4, 2) corners of each mark that is seen, in pixels."""
    dictionary, parameters = cv2.aruco.getPredefinedDictionary(DICTIONARY), cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    quads, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if not quads:
        return {}  # OpenCV then has no numbers, whatever its types say
    pairs = zip(np.ravel(np.asarray(numbers)).tolist(), quads, strict=True)
    return {int(number): np.asarray(quad, np.float64).reshape(4, 2) for number, quad in pairs}
