"""The page of a calibration: the corners over the photograph, residual arrows, the scale across the photograph."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.intrinsics import RMS_LIMIT_PX
from brushloop.calibrate.board.lens import Floats, Gray, rms
from brushloop.calibrate.board.pix2len import local_scale
from brushloop.calibrate.board.spec import describe
from brushloop.calibrate.board.view import LEAST_PX_PER_MM, NO_BOARD, WORST_INTERVAL, paper_mm, rig_of
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.report import (
    BLUE,
    ORANGE,
    Point,
    about,
    dress,
    photograph_uri,
    plot,
    plot_uri,
    source_point,
    write_page,
)
from brushloop.calibrate.session import FITTED
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording

ARROW_SHARE = 0.4
"""Length of a typical arrow, as a share of the distance between corners."""
SIDE_POINTS = 9
SCALE_GRID = (17, 13)


def write_calibration_page(recording: Recording, path: Path) -> Path:
    """Write the page of the calibration at `path` beside it; returns the page's path.

    Raises `CalibrationError` where the recording shows no board, and OSError.
    """
    made = load_artefact(path, Calibration)
    where = str(recording.path)
    image = _photograph(recording, made, where)
    seen = find_board(image, made.board, where)
    expected = made.to_image(paper_mm(seen, made.board))
    off = seen.pixels - expected
    size = np.linalg.norm(off, axis=1)
    dropped = np.zeros(len(size), np.bool_)
    dropped[np.argsort(-size)[: made.corners_dropped]] = True
    sheet_mm = rig_of(recording).sheet_mm
    frame = about(recording.header)
    label = frame["label"]
    return write_page(
        path.with_suffix(".html"),
        "calibration.html.j2",
        **frame,
        session=recording.header.session_id,
        picture=_picture(image, seen.pixels, expected, off, dropped, made, sheet_mm),
        verdict=list(_verdict(made)),
        trust=[source_point(recording.header.source), *_trust(made)],
        residuals=_residuals(off, dropped, label),
        scale=_scale(made, image.shape[1], image.shape[0], sheet_mm, label),
        worst=_worst(seen.ids.tolist(), size, dropped),
        facts=list(_facts(made, path)),
    )


def _photograph(recording: Recording, made: Calibration, where: str) -> Gray:
    stills = [still for _, still in recording.stills_of("board")]
    if not stills:
        raise CalibrationError(where, NO_BOARD)
    used = [still for still in stills if hashlib.sha256(still).hexdigest() == made.still_sha256]
    return decode_gray((used or stills)[-1], where)


def _picture(
    image: Gray,
    seen: Floats,
    expected: Floats,
    off: Floats,
    dropped: np.ndarray[Any, np.dtype[np.bool_]],
    made: Calibration,
    sheet_mm: tuple[float, float] | None,
) -> dict[str, Any]:
    """What the template draws over the photograph, in its pixels."""
    height, width = image.shape
    times = _times(expected, off[~dropped])
    ends = expected + times * off
    rows = zip(seen.round(1).tolist(), expected.round(1).tolist(), ends.round(1).tolist(), strict=True)
    corners = [
        {"at": at, "from": start, "to": end, "off_px": round(float(np.hypot(*one)), 2), "dropped": bool(out)}
        for (at, start, end), one, out in zip(rows, off, dropped, strict=True)
    ]
    return {
        "uri": photograph_uri(image),
        "width": width,
        "height": height,
        "unit": round(width / 1000, 2),
        "times": f"{times:g}",
        "corners": corners,
        "sheet": [] if sheet_mm is None else _outline(made, sheet_mm),
    }


def _times(expected: Floats, off: Floats) -> float:
    """How much longer than a residual its arrow is: 1, 2 or 5 times a power of ten."""
    apart = np.linalg.norm(expected[:, None] - expected[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    wanted = ARROW_SHARE * float(np.median(apart.min(axis=1))) / max(rms(off), 1e-6)
    power = 10.0 ** math.floor(math.log10(max(wanted, 1.0)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= max(wanted, 1.0))


def _outline(made: Calibration, sheet_mm: tuple[float, float]) -> list[list[float]]:
    """The sheet's edge in the photograph; its sides are bent where the lens bends them."""
    x, y = sheet_mm
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    along = np.linspace(0.0, 1.0, SIDE_POINTS)[:-1, None]
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    found: list[list[float]] = made.to_image(np.concatenate(sides)).round(1).tolist()
    return found


def _verdict(made: Calibration) -> Iterator[str]:
    reach = _reach(made)
    yield (
        f"One pixel is {made.mm_per_px:.5f} mm of paper in the middle of the board, known to ±{100 * reach:.3f} % "
        f"(95 %, if the board is printed to scale): 20 mm are known to ±{20 * reach:.4f} mm."
    )
    yield (
        f"{made.corners} corners lie {made.rms_px:.2f} px ({made.rms_px * made.mm_per_px:.3f} mm) from where the "
        "fitted plane puts them (root mean square)."
    )


def _trust(made: Calibration) -> Iterator[Point]:
    residual = f"The residual is {made.rms_px:.2f} px; a flat, sharp, still board gives 0.1 to 0.3 px"
    yield Point(made.rms_px <= RMS_LIMIT_PX, f"{residual}, and above {RMS_LIMIT_PX:g} px it warns.")
    reach = _reach(made)
    yield Point(reach <= WORST_INTERVAL, f"Scale known to ±{100 * reach:.3f} %, goal ±{100 * WORST_INTERVAL:g} %.")
    sharp = 1.0 / made.mm_per_px
    yield Point(sharp >= LEAST_PX_PER_MM, f"{sharp:.1f} px/mm; at least {LEAST_PX_PER_MM:g} are needed.")
    if made.corners_dropped:
        many = f"{made.corners_dropped} corners do" if made.corners_dropped > 1 else "One corner does"
        yield Point(
            False,
            f"{many} not lie on the plane of the others. The fit leaves out the corners that are crossed in blue.",
        )
    else:
        yield Point(True, "No corner was left out.")
    if made.lens.source == FITTED:
        words = "No lens file: k1 was fitted on this one board and is known only where corners were seen."
        yield Point(None, words)
    else:
        yield Point(True, f"Seen through the {made.lens.source}; k1 was refitted for this focus.")
    for flag in made.flags:
        yield Point(False, f"{flag[0].upper()}{flag[1:]}.")
    if made.label:
        yield Point(False, f"{made.label[0].upper()}{made.label[1:]}.")


def _reach(made: Calibration) -> float:
    return (made.mm_per_px_high - made.mm_per_px_low) / (2.0 * made.mm_per_px)


def _residuals(off: Floats, dropped: np.ndarray[Any, np.dtype[np.bool_]], label: str) -> str:
    figure, axis = plot(1, 1, (4.6, 4.4))
    kept = off[~dropped]
    rms_px = rms(kept)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    for circle in (rms_px, 2.0 * rms_px):
        axis.plot(circle * np.cos(turn), circle * np.sin(turn), color="0.6", lw=0.8)
    axis.plot(kept[:, 0], kept[:, 1], ".", ms=4, alpha=0.6, color=ORANGE)
    axis.set_aspect("equal")
    axis.invert_yaxis()
    dress(axis, f"residual of each corner ({label})", "to the right, px", "down, px")
    return plot_uri(figure)


def _scale(made: Calibration, width: int, height: int, sheet_mm: tuple[float, float] | None, label: str) -> str:
    """Contours of mm per pixel across the photograph."""
    figure, axis = plot(1, 1, (5.6, 4.4))
    across, down = (np.linspace(0.0, side - 1.0, n) for side, n in zip((width, height), SCALE_GRID, strict=True))
    scale = np.array([[local_scale(made.to_paper, np.array([x, y])) for x in across] for y in down])
    lines = axis.contour(across, down, scale, levels=8, colors=BLUE, linewidths=0.9)
    axis.clabel(lines, fontsize=8, fmt="%.4f")
    if sheet_mm is not None:
        outline = np.array(_outline(made, sheet_mm))
        axis.plot(*np.vstack([outline, outline[:1]]).T, color="0.5", lw=1.2)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_aspect("equal")
    dress(axis, f"mm per pixel across the photograph ({label})", "px", "px", grid="")
    return plot_uri(figure)


def _worst(ids: list[int], size: Floats, dropped: np.ndarray[Any, np.dtype[np.bool_]]) -> list[tuple[str, str, str]]:
    rows = sorted(zip(ids, size.tolist(), dropped.tolist(), strict=True), key=lambda row: -row[1])
    return [(str(name), f"{px:.2f}", "left out" if out else "used") for name, px, out in rows[:10]]


def _facts(made: Calibration, path: Path) -> Iterator[tuple[str, str]]:
    yield "session", made.session_id
    yield "source", made.source
    yield "recording", f"sha256 {made.recording_sha256}"
    yield "photograph of the board", f"sha256 {made.still_sha256}"
    yield "board", describe(made.board)
    yield "lens", f"{made.lens.source}; k1 {made.lens.distortion[0]:+.4f}"
    yield "95 % interval", f"{made.mm_per_px_low:.5f} to {made.mm_per_px_high:.5f} mm/px"
    yield "calibrated with", made.software
    yield "artefact", path.name
