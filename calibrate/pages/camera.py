"""The pages of what the camera was calibrated with: a session's paper plane, and a lens.

That of a calibration shows the corners over the photograph, residual arrows and the scale across the photograph; that
of a lens where corners were seen, their residuals, what each photograph contributes, and how the lens distorts.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.board.detect import BoardView, find_board
from brushloop.calibrate.board.intrinsics import GRID, GRID_WORDS, RMS_LIMIT_PX, LensFile, residuals
from brushloop.calibrate.board.lens import Floats, Gray, Lens, rms
from brushloop.calibrate.board.pix2len import local_scale
from brushloop.calibrate.board.spec import describe
from brushloop.calibrate.board.view import LEAST_PX_PER_MM, NO_BOARD, WORST_INTERVAL, paper_mm, rig_of
from brushloop.calibrate.calibration import FITTED, Calibration
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
    printable,
    source_point,
    write_page,
)
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording

Mask = NDArray[np.bool_]
FLAT_PX = "a flat, sharp, still board gives 0.1 to 0.3 px"
ARROW_SHARE = 0.4
"""Length of a typical arrow, as a share of the distance between corners."""
SIDE_POINTS = 9
SCALE_GRID = (17, 13)
LABEL = "photographs as given"
NOTE = "photographs do not say which camera took them, or whether they were simulated"
THUMBNAIL_PX, MAX_THUMBNAILS = 320, 30
MAX_BARS = 60
MAX_CORNERS = 6000
"""Corners that are drawn, evenly chosen from all."""
LENS_ARROW_SHARE = 0.015
"""Length of a typical arrow, as a share of the image's width."""
CURVE_POINTS = 60


def write_calibration_page(recording: Recording, path: Path) -> Path:
    """Write the page of the calibration at `path` beside it; returns the page's path.

    Raises `CalibrationError` where the recording shows no board, and OSError.
    """
    calibration = load_artefact(path, Calibration)
    where = str(recording.path)
    image = _photograph(recording, calibration, where)
    seen = find_board(image, calibration.board, where)
    expected = calibration.to_image(paper_mm(seen, calibration.board))
    off = seen.pixels - expected
    size = np.linalg.norm(off, axis=1)
    dropped = np.zeros(len(size), np.bool_)
    dropped[np.argsort(-size)[: calibration.corners_dropped]] = True
    sheet_mm = rig_of(recording).sheet_mm
    frame = about(recording.header)
    label = frame["label"]
    return write_page(
        path.with_suffix(".html"),
        "calibration.html.j2",
        **frame,
        session=recording.header.session_id,
        picture=_picture(image, seen.pixels, expected, off, dropped, calibration, sheet_mm),
        verdict=list(_verdict(calibration)),
        trust=[source_point(recording.header.source), *_trust(calibration)],
        residuals=_residuals(off, dropped, label),
        scale=_scale(calibration, image.shape[1], image.shape[0], sheet_mm, label),
        worst=_worst(seen.ids.tolist(), size, dropped),
        facts=list(_facts(calibration, path)),
    )


def _photograph(recording: Recording, calibration: Calibration, where: str) -> Gray:
    stills = [still for _, still in recording.stills_of("board")]
    if not stills:
        raise CalibrationError(where, NO_BOARD)
    used = [still for still in stills if hashlib.sha256(still).hexdigest() == calibration.still_sha256]
    return decode_gray((used or stills)[-1], where)


def _picture(
    image: Gray,
    seen: Floats,
    expected: Floats,
    off: Floats,
    dropped: Mask,
    calibration: Calibration,
    sheet_mm: tuple[float, float] | None,
) -> dict[str, Any]:
    """What the template draws over the photograph, in its pixels."""
    height, width = image.shape
    times = _times(expected, off[~dropped])
    ends = expected + times * off
    rows = zip(seen.round(1).tolist(), expected.round(1).tolist(), ends.round(1).tolist(), strict=True)
    corners = [
        {"at": at, "from": start, "to": end, "off_px": round(float(np.hypot(*residual)), 2), "dropped": bool(out)}
        for (at, start, end), residual, out in zip(rows, off, dropped, strict=True)
    ]
    return {
        "uri": photograph_uri(image),
        "width": width,
        "height": height,
        "unit": round(width / 1000, 2),
        "times": f"{times:g}",
        "corners": corners,
        "sheet": [] if sheet_mm is None else _outline(calibration, sheet_mm),
    }


def _times(expected: Floats, off: Floats) -> float:
    """How much longer than a residual its arrow is: 1, 2 or 5 times a power of ten."""
    apart = np.linalg.norm(expected[:, None] - expected[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    wanted = ARROW_SHARE * float(np.median(apart.min(axis=1))) / max(rms(off), 1e-6)
    power = 10.0 ** math.floor(math.log10(max(wanted, 1.0)))
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= max(wanted, 1.0))


def _outline(calibration: Calibration, sheet_mm: tuple[float, float]) -> list[list[float]]:
    """The sheet's edge in the photograph; its sides are bent where the lens bends them."""
    x, y = sheet_mm
    corners = np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]])
    along = np.linspace(0.0, 1.0, SIDE_POINTS)[:-1, None]
    sides = [a + along * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    return calibration.to_image(np.concatenate(sides)).round(1).tolist()


def _verdict(calibration: Calibration) -> Iterator[str]:
    reach = _reach(calibration)
    yield (
        f"One pixel is {calibration.mm_per_px:.5f} mm of paper in the middle of the board, known to "
        f"±{100 * reach:.3f} % (95 %, if the board is printed to scale): 20 mm are known to ±{20 * reach:.4f} mm."
    )
    yield (
        f"{calibration.corners} corners lie {calibration.rms_px:.2f} px "
        f"({calibration.rms_px * calibration.mm_per_px:.3f} mm) from where the fitted plane puts them "
        "(root mean square)."
    )


def _trust(calibration: Calibration) -> Iterator[Point]:
    residual = f"The residual is {calibration.rms_px:.2f} px; {FLAT_PX}, and above {RMS_LIMIT_PX:g} px it warns."
    yield Point(calibration.rms_px <= RMS_LIMIT_PX, residual)
    reach = _reach(calibration)
    yield Point(reach <= WORST_INTERVAL, f"Scale known to ±{100 * reach:.3f} %, goal ±{100 * WORST_INTERVAL:g} %.")
    sharp = 1.0 / calibration.mm_per_px
    yield Point(sharp >= LEAST_PX_PER_MM, f"{sharp:.1f} px/mm; at least {LEAST_PX_PER_MM:g} are needed.")
    if calibration.corners_dropped:
        many = f"{calibration.corners_dropped} corners do" if calibration.corners_dropped > 1 else "One corner does"
        yield Point(
            False,
            f"{many} not lie on the plane of the others. The fit leaves out the corners that are crossed in blue.",
        )
    else:
        yield Point(True, "No corner was left out.")
    if calibration.lens.source == FITTED:
        words = "No lens file: k1 was fitted on this one board and is known only where corners were seen."
        yield Point(None, words)
    else:
        yield Point(True, f"Seen through the {calibration.lens.source}; k1 was refitted for this focus.")
    for flag in calibration.flags:
        yield Point(False, f"{flag[0].upper()}{flag[1:]}.")
    if calibration.label:
        yield Point(False, f"{calibration.label[0].upper()}{calibration.label[1:]}.")


def _reach(calibration: Calibration) -> float:
    return (calibration.mm_per_px_high - calibration.mm_per_px_low) / (2.0 * calibration.mm_per_px)


def _residuals(off: Floats, dropped: Mask, label: str) -> str:
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


def _scale(calibration: Calibration, width: int, height: int, sheet_mm: tuple[float, float] | None, label: str) -> str:
    """Contours of mm per pixel across the photograph."""
    figure, axis = plot(1, 1, (5.6, 4.4))
    across, down = (np.linspace(0.0, side - 1.0, n) for side, n in zip((width, height), SCALE_GRID, strict=True))
    scale = np.array([[local_scale(calibration.to_paper, np.array([x, y])) for x in across] for y in down])
    lines = axis.contour(across, down, scale, levels=8, colors=BLUE, linewidths=0.9)
    axis.clabel(lines, fontsize=8, fmt="%.4f")
    if sheet_mm is not None:
        outline = np.array(_outline(calibration, sheet_mm))
        axis.plot(*np.vstack([outline, outline[:1]]).T, color="0.5", lw=1.2)
    axis.set_xlim(0, width)
    axis.set_ylim(height, 0)
    axis.set_aspect("equal")
    dress(axis, f"mm per pixel across the photograph ({label})", "px", "px", grid="")
    return plot_uri(figure)


def _worst(ids: list[int], size: Floats, dropped: Mask) -> list[tuple[str, str, str]]:
    rows = sorted(zip(ids, size.tolist(), dropped.tolist(), strict=True), key=lambda row: -row[1])
    return [(str(name), f"{px:.2f}", "left out" if out else "used") for name, px, out in rows[:10]]


def _facts(calibration: Calibration, path: Path) -> Iterator[tuple[str, str]]:
    yield "session", calibration.session_id
    yield "source", calibration.source
    yield "recording", f"sha256 {calibration.recording_sha256}"
    yield "photograph of the board", f"sha256 {calibration.still_sha256}"
    yield "board", describe(calibration.board)
    yield "lens", f"{calibration.lens.source}; k1 {calibration.lens.distortion[0]:+.4f}"
    yield "95 % interval", f"{calibration.mm_per_px_low:.5f} to {calibration.mm_per_px_high:.5f} mm/px"
    yield "calibrated with", calibration.software
    yield "artefact", path.name


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small picture of a photograph."""

    uri: str
    size_px: tuple[int, int]
    """Width and height of the photograph itself."""


def thumbnail(image: Gray) -> Thumbnail:
    """Make the small picture of a photograph (h, w)."""
    return Thumbnail(photograph_uri(image, THUMBNAIL_PX), (image.shape[1], image.shape[0]))


def write_lens_page(
    path: Path, file: LensFile, views: Sequence[BoardView], thumbnails: Mapping[str, Thumbnail]
) -> Path:
    """Write the page of the lens file at `path` beside it; returns the page's path. Raises OSError.

    `views` are all boards that were found, by name as in `file`; `thumbnails` are of any photographs.
    """
    kept = [view for view in views if view.name in file.residuals_px]
    return write_page(
        path.with_suffix(".html"),
        "lens.html.j2",
        label=LABEL,
        note=NOTE,
        file=file,
        coverage=_coverage(file.lens, kept),
        verdict=list(_lens_verdict(file)),
        trust=list(_lens_trust(file)),
        residuals=_lens_residuals(file),
        bend=_bend(file.lens),
        photographs=list(_photographs(file, {view.name: view for view in views}, thumbnails)),
        not_shown=max(0, len(file.photographs) - MAX_THUMBNAILS),
        facts=list(_lens_facts(file, path)),
    )


def _coverage(lens: Lens, kept: Sequence[BoardView]) -> dict[str, Any]:
    """Corners of all used photographs on the image, and how many lie in each part of it."""
    width, height = lens.size_px
    seen = np.concatenate([view.pixels for view in kept])
    off = np.concatenate([residuals(lens, view) for view in kept])
    counts, _, _ = np.histogram2d(seen[:, 1], seen[:, 0], bins=(GRID[1], GRID[0]), range=((0, height), (0, width)))
    step = max(1, -(-len(seen) // MAX_CORNERS))
    times = max(1.0, round(LENS_ARROW_SHARE * width / max(rms(off), 1e-6), -1))
    ends = seen + times * off
    lines = np.hstack([seen, ends])[::step].tolist()
    arrows = [f"M{x:.1f} {y:.1f}L{there:.1f} {below:.1f}" for x, y, there, below in lines]
    cells = [
        {
            "word": GRID_WORDS[row][column],
            "corners": int(counts[row, column]),
            "x": round(column * width / GRID[0], 1),
            "y": round(row * height / GRID[1], 1),
        }
        for row in range(GRID[1])
        for column in range(GRID[0])
    ]
    return {
        "width": width,
        "height": height,
        "across": round(width / GRID[0], 1),
        "down": round(height / GRID[1], 1),
        "unit": round(width / 1000, 2),
        "times": f"{times:g}",
        "dots": "".join(f"M{x:.1f} {y:.1f}h0" for x, y in seen[::step].tolist()),
        "arrows": "".join(arrows),
        "cells": cells,
        "corners": len(seen),
    }


def _lens_verdict(file: LensFile) -> Iterator[str]:
    reach = file.focal_reach_px
    known = "with unknown precision" if reach is None else f"known to ±{reach[0]:.1f} and ±{reach[1]:.1f} px (95 %)"
    yield f"The focal lengths are {file.lens.matrix[0]:.1f} px across and {file.lens.matrix[1]:.1f} px down, {known}."
    yield (
        f"The corners of {len(file.residuals_px)} photographs, which hold the board in {file.ways} ways, lie "
        f"{file.rms_px:.2f} px from where this lens puts them (root mean square)."
    )


def _lens_trust(file: LensFile) -> Iterator[Point]:
    yield Point(None, f"{NOTE[0].upper()}{NOTE[1:]}: their names and hashes are below.")
    words = f"The residual is {file.rms_px:.2f} px; the limit is {file.rms_limit_px:g} px; {FLAT_PX}."
    yield Point(file.rms_px <= file.rms_limit_px, words)
    if file.focal_se_px is None:
        yield Point(False, f"The board is held in {file.ways} ways: too few to say how precisely the lens is known.")
    for warning in file.warnings:
        yield Point(False, f"{warning[0].upper()}{warning[1:]}.")
    for advice in file.guidance:
        yield Point(False, f"To do: {advice}.")
    if not file.guidance:
        yield Point(True, "Every part of the image was covered, and the board was slanted often enough.")
    for name, residual in file.dropped.items():
        yield Point(None, f"{name} does not fit the others ({residual:.2f} px) and was left out.")


def _lens_residuals(file: LensFile) -> str:
    """A bar for each photograph, the largest at the top."""
    rows = sorted([*file.residuals_px.items(), *file.dropped.items()], key=lambda row: row[1])[-MAX_BARS:]
    figure, axis = plot(1, 1, (7.2, 1.0 + 0.22 * len(rows)))
    colours = [ORANGE if name in file.dropped else BLUE for name, _ in rows]
    axis.barh(range(len(rows)), [px for _, px in rows], color=colours)
    axis.set_yticks(range(len(rows)), [_short(name) for name, _ in rows], fontsize=8, parse_math=False)
    axis.axvline(file.rms_limit_px, color="0.4", lw=1.0, ls="--")
    dress(axis, f"residual of each photograph ({LABEL})", "residual, px", grid="x")
    return plot_uri(figure)


def _short(name: str) -> str:
    text = printable(name)
    return text if len(text) <= 28 else f"…{text[-27:]}"


def _bend(lens: Lens) -> str:
    """How far the lens moves a point, from the middle to the farthest corner of the image."""
    width, height = lens.size_px
    centre = np.array(lens.matrix[2:])
    corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
    far = corners[np.argmax(np.linalg.norm(corners - centre, axis=1))]
    share = np.linspace(0.0, 1.0, CURVE_POINTS)[:, None]
    seen = centre + share * (far - centre)
    radius = np.linalg.norm(seen - centre, axis=1)
    moved = radius - np.linalg.norm(lens.undistorted(seen) - centre, axis=1)
    figure, axis = plot(1, 1, (5.6, 3.2))
    axis.axhline(0.0, color="0.6", lw=0.8)
    axis.plot(radius, moved, color=BLUE, lw=1.5)
    title = f"how far the lens moves a point ({LABEL})"
    dress(axis, title, "distance from the middle of the lens, px", "outward (+) or inward (−), px")
    return plot_uri(figure)


def _photographs(
    file: LensFile, views: Mapping[str, BoardView], thumbnails: Mapping[str, Thumbnail]
) -> Iterator[dict[str, Any]]:
    for name in list(file.photographs)[:MAX_THUMBNAILS]:
        small = thumbnails.get(name)
        if small is None:
            continue
        if name in file.residuals_px:
            words = f"{file.residuals_px[name]:.2f} px, slanted by {file.slants_deg[name]:.0f}°"
        elif name in file.dropped:
            words = f"left out: {file.dropped[name]:.2f} px"
        else:
            words = f"not used: {file.unusable.get(name, 'no board')}"
        corners: list[list[float]] = views[name].pixels.tolist() if name in views else []
        yield {
            "name": name,
            "uri": small.uri,
            "width": small.size_px[0],
            "height": small.size_px[1],
            "unit": round(small.size_px[0] / 100, 2),
            "words": words,
            "used": name in file.residuals_px,
            "dots": "".join(f"M{x:.0f} {y:.0f}h0" for x, y in corners),
        }


def _lens_facts(file: LensFile, path: Path) -> Iterator[tuple[str, str]]:
    width, height = file.lens.size_px
    yield "photographs", f"{len(file.photographs)}, {width} × {height} px"
    yield "board", file.board
    fx, fy, cx, cy = file.lens.matrix
    yield "fx, fy, cx, cy", f"{fx:.2f}, {fy:.2f}, {cx:.2f}, {cy:.2f} px"
    yield "k1, k2, p1, p2, k3", ", ".join(f"{value:+.4f}" for value in file.lens.distortion)
    yield "fitted with", file.software
    yield "artefact", path.name
