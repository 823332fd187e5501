"""`brushloop calibrate SESSION` as a function: the calibration of a session, and its page; and that of a lens.

The page shows the corners over the photograph with residual arrows, and the scale across the photograph.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from brushloop.calibrate.artefact import made_by, put_to_use
from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import FITTED, RMS_LIMIT_PX, Floats, Gray, fit_lens, read_lens
from brushloop.calibrate.board.pix2len import local_scale, paper_mm, see_board_and_lens
from brushloop.calibrate.board.spec import BoardView, describe, named_board
from brushloop.calibrate.commands import CalibrateRequest, LensRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written, read_gray
from brushloop.calibrate.report import Point, about, framed, photograph_uri, source_point, write_page
from brushloop.calibrate.session import Calibration, rig_of
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, counted, unseen

MOVED_PX = 0.5
"""Median distance of the board's corners from where they were before, above which camera or board was touched."""
MANY_OUT = 0.02
"""Share of corners off the plane above which the board may be bent; the fit refuses a tenth."""
LEAST_PX_PER_MM = 4.0
"""Below this a tip of 0.5 mm is two pixels wide."""
WORST_INTERVAL = 5e-4
"""Relative half width of pix2len's interval: 0.01 mm over 20 mm."""
ARROW_TIMES = 100
"""How much longer than its residual each arrow is drawn, on every page, so that pages can be compared."""
SIDE_POINTS = 9
SCALE_GRID = (17, 13)
MOST_CONTOURS = 7


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The calibration that a session uses from now on."""

    calibration: Calibration
    path: Path
    page: Path
    moved: tuple[str, ...]
    """Earlier photographs in which the board lies elsewhere."""

    def lines(self) -> list[str]:
        """What the command prints."""
        calibration = self.calibration
        low, high = calibration.mm_per_px_low, calibration.mm_per_px_high
        return [
            *(f"warning: {problem}" for problem in (*calibration.flags, *self.moved)),
            f"pix2len {calibration.mm_per_px:.5f} mm/px (95 %: {low:.5f} to {high:.5f}), "
            f"board residual {calibration.rms_px:.3f} px over {calibration.corners} corners, {calibration.source}",
            f"lens: {calibration.lens.source}",
            str(self.path),
            f"Page: {self.page}",
        ]

    def _repr_html_(self) -> str:
        return framed(self.page)


def calibrate_session(
    request: CalibrateRequest, progress: Progress = unseen, opened: Recording | None = None
) -> Calibrated:
    """Calibrate a session by its last view of the board, use the result from now on, and write its page.

    `opened` is its recording, where it is open already. Raises `CalibrationError`, also for an unknown lens that
    visibly distorts.
    """
    recording = opened or Recording(request.session)
    where = str(recording.path)
    if recording.header.source.imported:
        raise CalibrationError(where, "is an import and has its own scale: continue with `brushloop analyse`")
    rig = rig_of(recording)
    known = rig.lens if request.lens is None else read_lens(request.lens)
    stills = list(recording.stills_of("board"))
    if not stills:
        raise CalibrationError(where, "holds no photograph of the board, which a `board` step takes")
    *earlier, (last_ns, still) = stills
    image = decode_gray(still, where)
    view, plane = see_board_and_lens(image, rig.board, known, where, rig.sheet_mm)
    calibration = Calibration(
        **plane.model_dump(),
        session_id=recording.header.session_id,
        source=recording.header.source,
        recording_sha256=recording.sha256,
        software=made_by(),
        board=rig.board,
        still_sha256=hashlib.sha256(still).hexdigest(),
    )
    looked_at = counted(earlier, "earlier photographs of the board compared", len(earlier), progress)
    compared = [_moved(calibration, before, (last_ns - t_ns) / 60e9, where) for t_ns, before in looked_at]
    moved = tuple(filter(None, compared))
    path = put_to_use(calibration, recording.path.parent)
    page = write_page(
        path.with_suffix(".html"),
        "calibration.html.j2",
        **about(recording.header),
        calibration=calibration,
        picture=_picture(calibration, image, view),
        sheet=[] if rig.sheet_mm is None else _outline(calibration, rig.sheet_mm).round(1).tolist(),
        trust=[source_point(recording.header.source), *_trust(calibration, moved)],
        contours=_contours(calibration, image.shape[1], image.shape[0]),
        recorded=recording,
        board=describe(calibration.board),
    )
    return Calibrated(calibration, path, page, moved)


def calibrate_lens(request: LensRequest, progress: Progress = unseen) -> Written:
    """Fit a lens to photographs of one board, and write its file. Raises `CalibrationError`."""
    board, paths = named_board(request), request.photographs
    seen, unusable, digests = list[BoardView](), dict[str, str](), dict[str, str]()
    for path in counted(paths, "photographs searched for the board", len(paths), progress):
        image = read_gray(path)
        digests[str(path)] = file_sha256(path)
        try:
            seen.append(find_board(image, board, str(path)))
        except CalibrationError as error:
            unusable[str(path)] = error.what
    lens = fit_lens(seen, describe(board), digests, unusable)
    path = lens.save(request.out)
    return Written(path, (*lens.lines(), str(path)))


def _moved(calibration: Calibration, still: bytes, minutes: float, where: str) -> str:
    """What an earlier photograph of the board says against the calibration; empty where the board lay in its place."""
    before = f"{minutes:.0f} min before the last photograph of the board, the board"
    try:
        view = find_board(decode_gray(still, where), calibration.board, where)
    except CalibrationError as error:
        return f"{before} is not seen: {error.what}"
    off = np.linalg.norm(view.pixels - calibration.to_image(paper_mm(view, calibration.board)), axis=1)
    off_px = float(np.median(off))
    if off_px <= MOVED_PX:
        return ""
    off_mm = off_px * calibration.mm_per_px
    return f"{before} lay {off_px:.1f} px ({off_mm:.2f} mm) away: camera or board moved, so strokes are misplaced"


def _picture(calibration: Calibration, image: Gray, view: BoardView) -> dict[str, Any]:
    """What the template draws over the photograph, in its pixels."""
    height, width = image.shape
    expected = calibration.to_image(paper_mm(view, calibration.board))
    off = view.pixels - expected
    off_px = np.linalg.norm(off, axis=1)
    ends = expected + ARROW_TIMES * off
    corners = (*(each.round(1).tolist() for each in (view.pixels, expected, ends)), off_px.round(2).tolist())
    return {
        "uri": photograph_uri(image),
        "width": width,
        "height": height,
        "unit": round(width / 1000, 2),
        "times": ARROW_TIMES,
        "corners": list(zip(*corners, strict=True)),
        "dropped": np.argsort(-off_px)[: calibration.corners_dropped].tolist(),
    }


def _outline(calibration: Calibration, sheet_mm: tuple[float, float]) -> Floats:
    """(n, 2) points of the sheet's edge in the photograph; its sides are bent where the lens bends them."""
    x, y = sheet_mm
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    sides = np.linspace(corners, np.roll(corners, -1, axis=0), SIDE_POINTS)[:-1]
    return calibration.to_image(sides.swapaxes(0, 1).reshape(-1, 2))


def _trust(calibration: Calibration, moved: Sequence[str]) -> Iterator[Point]:
    residual = f"The residual is {calibration.rms_px:.2f} px; at most {RMS_LIMIT_PX:g} px are good."
    yield Point(calibration.rms_px <= RMS_LIMIT_PX, residual)
    known = calibration.relative_reach
    yield Point(known <= WORST_INTERVAL, f"Scale known to ±{100 * known:.3f} % (goal: {100 * WORST_INTERVAL:g} %).")
    sharp = 1.0 / calibration.mm_per_px
    yield Point(sharp >= LEAST_PX_PER_MM, f"The image has {sharp:.1f} px/mm; at least {LEAST_PX_PER_MM:g} are needed.")
    out = calibration.corners_dropped
    usual = "a few, as under the edge of the sheet, are usual" if out <= MANY_OUT * (out + calibration.corners) else ""
    words = f"{out} of {out + calibration.corners} corners do not lie on the plane of the others and are left out"
    yield Point(True if not out else None if usual else False, f"{words}: {usual or 'is the board flat?'}.")
    if calibration.lens.source == FITTED:
        yield Point(None, "Without a lens file, k1 is fitted on this one board and known only where corners were seen.")
    for problem in (*calibration.flags, *moved):
        yield Point(False, f"{problem[0].upper()}{problem[1:]}.")
    if not moved:
        yield Point(True, "The board lay in the same place in every photograph of it.")


def _contours(calibration: Calibration, width: int, height: int) -> list[tuple[str, list[list[float]]]]:
    """Contours of mm per pixel across a photograph: the value and the (n, 2) points, in pixels, of each line."""
    from contourpy import contour_generator
    from matplotlib.ticker import MaxNLocator  # slow to import

    across, down = (np.linspace(0.0, side - 1.0, n) for side, n in zip((width, height), SCALE_GRID, strict=True))
    scale = np.array([[local_scale(calibration.to_paper, np.array([x, y])) for x in across] for y in down])
    generator = contour_generator(across, down, scale)
    values = MaxNLocator(MOST_CONTOURS).tick_values(float(scale.min()), float(scale.max()))
    lines = ((value, line) for value in values for line in cast("list[Floats]", generator.lines(value)))
    return [(f"{value:.6g}", line.round(1).tolist()) for value, line in lines]
