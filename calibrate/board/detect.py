"""Find the corners of a board in a photograph, or say why they cannot be found.

Corners are crossings of edges, each followed for half a square. A window around a corner sees few pixels of each edge,
and where the edge runs along the pixel rows they all have the same error. Half a square crosses pixel rows at several
phases, and their errors cancel.
"""

from __future__ import annotations

from collections import Counter

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Floats, Gray, apply
from brushloop.calibrate.board.spec import Board, BoardSpec, BoardView, Checkerboard, charuco_board
from brushloop.calibrate.errors import CalibrationError

MIN_CORNERS = 8
WINDOW_SHARE = 0.3
"""Half the corner refinement window, as a share of the distance to the next edge, which it must not include."""
MOST_WINDOW_PX = 8
SATURATED = 254
MOST_SATURATED = 0.4
"""Share of saturated pixels above which a view is flagged: light that bleeds over an edge moves it."""
PARTLY_HIDDEN = 0.7
"""Share of corners below which a board is reported as partly hidden."""
CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
LEAST_CONTRAST = 30.0
BLANK = "is blank: nothing in it is darker than the rest"
GRID_ERROR = 0.25
"""Largest distance of a corner from a regular grid, in squares: a strong lens displaces corners by less."""
ALONG_SHARE = 0.45
"""How far an edge is followed to either side, as a share of a square."""
MOST_ALONG_PX = 40
ACROSS_SHARE = 0.6
"""Distance searched across an edge, as a share of the distance to the next one."""
MOST_ACROSS_PX = 6
LEAST_ACROSS_PX = 2.5
CORNER_PX = 3
"""Distance from the corner within which the two edges blur into each other."""
LEAST_EDGE_CONTRAST = 0.4
"""Least contrast, as a share of the median: less is a shadow, a fold, or the edge of a sheet on the board."""
LEAST_SEEN = 0.6
MOST_WALK_PX = 1.5


def find_board(image: Gray, board: Board, name: str, expected: int | None = None) -> BoardView:
    """Find the corners of the board in a gray photograph. Raises `CalibrationError`, which says what is wrong.

    `expected` is the number of corners that a sheet on the board leaves visible; all of them by default.
    """
    corners = _checkerboard(image, board, name) if isinstance(board, Checkerboard) else _charuco(image, board, name)
    pixels, board_mm, total = corners
    flags, wanted = list[str](), total if expected is None else expected
    saturated = float(np.count_nonzero(image >= SATURATED)) / image.size
    if saturated > MOST_SATURATED:
        flags.append(f"{100 * saturated:.0f} % of the pixels are saturated: expose less")
    if len(pixels) < PARTLY_HIDDEN * wanted:
        flags.append(f"only {len(pixels)} of {wanted} corners are seen: the board is partly hidden or out of view")
    return BoardView(name, (image.shape[1], image.shape[0]), pixels, board_mm, tuple(flags))


def _blank(image: Gray) -> bool:
    return float(np.percentile(image, 99) - np.percentile(image, 1)) < LEAST_CONTRAST


def _charuco(image: Gray, spec: BoardSpec, name: str) -> tuple[Floats, Floats, int]:
    board = charuco_board(spec, name)
    pixels, ids, numbers = _detected(image, board)
    twice = sorted(number for number, times in Counter(int(n) for n in numbers).items() if times > 1)
    if len(twice) > 1:
        raise CalibrationError(name, f"shows two boards: markers {twice[0]} and {twice[1]} appear twice")
    own = np.asarray(board.getIds()).ravel()
    foreign = np.setdiff1d(numbers, own)
    if len(foreign) > max(1, 0.1 * len(numbers)):
        raise CalibrationError(
            name,
            f"shows markers up to number {numbers.max()}, but a board of {spec.squares[0]} x {spec.squares[1]} squares "
            f"has 0 to {own.max()}: it is another board",
        )
    total = (spec.squares[0] - 1) * (spec.squares[1] - 1)
    if len(ids) < MIN_CORNERS:
        why = f"{len(ids)} of {total} board corners found, at least {MIN_CORNERS} are needed"
        if _blank(image):
            raise CalibrationError(name, BLANK)
        if len(numbers) > MIN_CORNERS:
            why += f", though {len(numbers)} markers are seen: they are not arranged as on this board"
        *_, mirrored = _detected(np.ascontiguousarray(image[:, ::-1]), board)
        if len(mirrored) >= max(4, 2 * len(numbers)):
            why = "the photograph is mirrored: its markers can only be read in reverse"
        raise CalibrationError(name, why)
    board_mm = np.asarray(board.getChessboardCorners(), np.float64)[ids, :2]
    gap_mm = 0.5 * (spec.square_mm - spec.marker_mm)
    return _refined(image, pixels, board_mm, spec.square_mm, gap_mm), board_mm, total


def _detected(image: Gray, board: cv2.aruco.CharucoBoard) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """(n, 2) corners of the board and their numbers (n,); and the numbers of all markers, those of others too."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.CharucoDetector(board, detectorParams=parameters)
    pixels, ids, _, markers = detector.detectBoard(image)
    # OpenCV gives None for nothing, whatever its types say.
    empty = np.zeros(0)
    corners, own, every = (
        np.ravel(empty if each is None else each)  # pyright: ignore[reportUnnecessaryComparison]
        for each in (pixels, ids, markers)
    )
    return corners.reshape(-1, 2).astype(np.float64), own.astype(np.int64), every.astype(np.int64)


def _checkerboard(image: Gray, board: Checkerboard, name: str) -> tuple[Floats, Floats, int]:
    columns, rows = board.inner_corners
    pixels = _squares(image, board.inner_corners)
    if pixels is None:
        raise CalibrationError(name, _why_no_board(image, board.inner_corners))
    board_mm = (_grid(board.inner_corners) + 1.0) * board.square_mm
    return _refined(image, pixels, board_mm, board.square_mm, board.square_mm), board_mm, columns * rows


def _grid(inner: tuple[int, int]) -> Floats:
    """(n, 2) column and row of each inner corner."""
    return np.stack(np.meshgrid(*map(np.arange, inner)), axis=-1).reshape(-1, 2).astype(np.float64)


def _squares(image: Gray, inner: tuple[int, int], *, quick: bool = False) -> Floats | None:
    if min(inner) < 3:
        return None
    flags = CLASSIC | cv2.CALIB_CB_FAST_CHECK if quick else CLASSIC
    found, corners = cv2.findChessboardCorners(image, inner, None, flags)
    if not found and not quick:
        found, corners = cv2.findChessboardCornersSB(image, inner, None, cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    pixels = np.asarray(corners, np.float64).reshape(-1, 2)
    return pixels if _is_grid(pixels, inner) else None


def _is_grid(pixels: Floats, inner: tuple[int, int]) -> bool:
    """Whether the corners fit a flat board: OpenCV sometimes mistakes the edge of a shadow for a row."""
    places = _grid(inner)
    to_grid, _ = cv2.findHomography(pixels, places, 0)
    if to_grid is None:  # pyright: ignore[reportUnnecessaryComparison]
        return False
    return bool(np.linalg.norm(apply(np.asarray(to_grid, np.float64), pixels) - places, axis=1).max() < GRID_ERROR)


def _why_no_board(image: Gray, inner: tuple[int, int]) -> str:
    columns, rows = inner
    if _blank(image):
        return BLANK
    more = ((columns + 1, rows), (columns, rows + 1), (columns + 1, rows + 1))
    fewer = ((columns - 1, rows), (columns, rows - 1), (columns - 1, rows - 1))
    for other in (*more, *fewer):
        if _squares(image, other, quick=True) is not None:
            return f"shows a board of {other[0]} x {other[1]} inner corners, not {columns} x {rows}"
    return f"shows no complete board of {columns} x {rows} inner corners; a plain checkerboard must be fully visible"


def _refined(image: Gray, pixels: Floats, board_mm: Floats, square_mm: float, gap_mm: float) -> Floats:
    """(n, 2) corners moved to where their edges cross; `gap_mm` lies between an edge and the nearest marker or edge."""
    to_image, _ = cv2.findHomography(board_mm, pixels, cv2.LMEDS)
    if to_image is None:  # pyright: ignore[reportUnnecessaryComparison]
        return pixels
    to_px = np.asarray(to_image, np.float64)
    here = apply(to_px, board_mm)
    right, down = (apply(to_px, board_mm + step) - here for step in square_mm * np.eye(2))
    # Where the board is smallest in the photograph.
    gap_px = gap_mm / square_mm * float(np.linalg.norm([right, down], axis=2).min())
    window = int(np.clip(round(WINDOW_SHARE * gap_px), 2, MOST_WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-4)
    start = pixels.astype(np.float32).reshape(-1, 1, 2).copy()
    fine = np.asarray(cv2.cornerSubPix(image, start, (window, window), (-1, -1), criteria), np.float64).reshape(-1, 2)
    # A corner that moved beyond the window has settled on something else.
    walked = np.linalg.norm(fine - pixels, axis=1) > window
    return on_edges(image, np.where(walked[:, None], pixels, fine), right, down, gap_px)


def on_edges(image: Gray, pixels: Floats, right_px: Floats, down_px: Floats, gap_px: float) -> Floats:
    """(n, 2) corners moved to where their edges cross; those whose edges are not seen well enough stay.

    `right_px` and `down_px` are (n, 2): from each corner one square to the right and one down on the board. `gap_px` is
    the distance from an edge to the nearest marker or edge.
    """
    across = min(MOST_ACROSS_PX, ACROSS_SHARE * gap_px)
    if across < LEAST_ACROSS_PX:
        return pixels
    edges = (_edge(image, pixels, towards_px, across) for towards_px in (right_px, down_px))
    rows, offsets, seen = (np.stack(both, axis=1) for both in zip(*edges, strict=True))
    crossing = seen.all(axis=1)
    rows[~crossing] = np.eye(2)
    step = np.linalg.solve(rows, offsets[..., None])[..., 0]
    good = crossing & (np.linalg.norm(step, axis=1) <= MOST_WALK_PX)
    return np.where(good[:, None], pixels + step, pixels)


def _edge(image: Gray, pixels: Floats, towards_px: Floats, across: float) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Normal (n, 2) of the edge near each corner, its distance along that and whether it is seen (n,)."""
    length = np.linalg.norm(towards_px, axis=1)
    direction = towards_px / length[:, None]
    normal = np.column_stack([-direction[:, 1], direction[:, 0]])
    reach = int(np.clip(round(ALONG_SHARE * float(length.min())), CORNER_PX + 2, MOST_ALONG_PX))
    t = np.array([s for s in range(-reach, reach + 1) if abs(s) >= CORNER_PX], np.float64)
    s = np.arange(-round(2 * across), round(2 * across) + 1) / 2.0
    places = (
        pixels[:, None, None]
        + t[None, :, None, None] * direction[:, None, None]
        + s[None, None, :, None] * normal[:, None, None]
    )
    flat = places.reshape(len(pixels), -1, 2).astype(np.float32)
    levels = np.asarray(cv2.remap(image, flat, np.empty(0), cv2.INTER_LINEAR), np.float64)
    steps = np.diff(levels.reshape(len(pixels), len(t), len(s)), axis=2)
    between = (s[1:] + s[:-1]) / 2.0
    # Dark and light swap sides at the corner, so each side has its own sign.
    for side in (t < 0, t > 0):
        sign = np.sign(steps[:, side].sum(axis=(1, 2)))
        steps[:, side] *= np.where(sign == 0.0, 1.0, sign)[:, None, None]
    contrast = steps.sum(axis=2)
    good = contrast > LEAST_EDGE_CONTRAST * float(np.median(contrast))
    offsets = (steps * between).sum(axis=2) / np.where(good, contrast, 1.0)
    seen = (good[:, t < 0].mean(axis=1) >= LEAST_SEEN) & (good[:, t > 0].mean(axis=1) >= LEAST_SEEN)
    # A lens bends edges, so a parabola is fitted; its value at the corner is the offset.
    terms = np.stack([np.ones_like(t), t, t * t], axis=1)
    used = good | ~seen[:, None]  # an edge that is not seen gets some parabola, which nobody reads
    left = np.abs(offsets - _parabolas(terms, offsets, used) @ terms.T)
    typical = np.nanmedian(np.where(used, left, np.nan), axis=1, keepdims=True)
    offset, slope, _ = _parabolas(terms, offsets, used & (left < np.maximum(0.5, 3.0 * typical))).T
    return normal - slope[:, None] * direction, offset, seen


def _parabolas(terms: Floats, offsets: Floats, used: NDArray[np.bool_]) -> Floats:
    """(n, 3) the parabola through the used ones of each row of offsets."""
    return (np.linalg.pinv(terms * used[..., None]) @ (offsets * used)[..., None])[..., 0]
