"""The page of a lens: where corners were seen, their residuals, what each photograph contributes, how it distorts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.board.detect import BoardView
from brushloop.calibrate.board.intrinsics import GRID, GRID_WORDS, LensFile, residuals
from brushloop.calibrate.board.lens import Gray, Lens, rms
from brushloop.calibrate.report import (
    BLUE,
    ORANGE,
    Point,
    dress,
    photograph_uri,
    plot,
    plot_uri,
    printable,
    write_page,
)

LABEL = "photographs as given"
NOTE = "photographs do not say which camera took them, or whether they were simulated"
THUMBNAIL_PX, MAX_THUMBNAILS = 320, 30
MAX_BARS = 60
MAX_CORNERS = 6000
"""Corners that are drawn, evenly chosen from all."""
ARROW_SHARE = 0.015
"""Length of a typical arrow, as a share of the image's width."""
CURVE_POINTS = 60


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
        verdict=list(_verdict(file)),
        trust=list(_trust(file)),
        residuals=_residuals(file),
        bend=_bend(file.lens),
        photographs=list(_photographs(file, {view.name: view for view in views}, thumbnails)),
        not_shown=max(0, len(file.photographs) - MAX_THUMBNAILS),
        facts=list(_facts(file, path)),
    )


def _coverage(lens: Lens, kept: Sequence[BoardView]) -> dict[str, Any]:
    """Corners of all used photographs on the image, and how many lie in each part of it."""
    width, height = lens.size_px
    seen = np.concatenate([view.pixels for view in kept])
    off = np.concatenate([residuals(lens, view) for view in kept])
    counts, _, _ = np.histogram2d(seen[:, 1], seen[:, 0], bins=(GRID[1], GRID[0]), range=((0, height), (0, width)))
    step = max(1, -(-len(seen) // MAX_CORNERS))
    times = max(1.0, round(ARROW_SHARE * width / max(rms(off), 1e-6), -1))
    ends = seen + times * off
    starts_text = (f"{x:.1f} {y:.1f}" for x, y in seen[::step].tolist())
    ends_text = (f"{x:.1f} {y:.1f}" for x, y in ends[::step].tolist())
    arrows = [f"M{start}L{end}" for start, end in zip(starts_text, ends_text, strict=True)]
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


def _verdict(file: LensFile) -> Iterator[str]:
    reach = file.focal_reach_px
    known = "with unknown precision" if reach is None else f"known to ±{reach[0]:.1f} and ±{reach[1]:.1f} px (95 %)"
    yield f"The focal lengths are {file.lens.matrix[0]:.1f} px across and {file.lens.matrix[1]:.1f} px down, {known}."
    yield (
        f"The corners of {len(file.residuals_px)} photographs, which hold the board in {file.ways} ways, lie "
        f"{file.rms_px:.2f} px from where this lens puts them (root mean square)."
    )


def _trust(file: LensFile) -> Iterator[Point]:
    yield Point(None, f"{NOTE[0].upper()}{NOTE[1:]}: their names and hashes are below.")
    words = f"The residual is {file.rms_px:.2f} px; the limit is {file.rms_limit_px:g} px"
    yield Point(file.rms_px <= file.rms_limit_px, f"{words}; a flat, sharp, still board gives 0.1 to 0.3 px.")
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


def _residuals(file: LensFile) -> str:
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


def _facts(file: LensFile, path: Path) -> Iterator[tuple[str, str]]:
    width, height = file.lens.size_px
    yield "photographs", f"{len(file.photographs)}, {width} × {height} px"
    yield "board", file.board
    fx, fy, cx, cy = file.lens.matrix
    yield "fx, fy, cx, cy", f"{fx:.2f}, {fy:.2f}, {cx:.2f}, {cy:.2f} px"
    yield "k1, k2, p1, p2, k3", ", ".join(f"{value:+.4f}" for value in file.lens.distortion)
    yield "fitted with", file.software
    yield "artefact", path.name
