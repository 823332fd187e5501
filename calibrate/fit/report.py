"""The page of a fit: the fitted outline over the ink of each cell, sizes of the marks, held-out scores."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.artefact import made_by
from brushloop.calibrate.fit.captures import (
    SPREAD_MM,
    Captures,
    Cell,
    Floats,
    Grid,
    Pressed,
    Size,
    by_cell,
    measure,
    middle,
)
from brushloop.calibrate.fit.heldout import FITTED, UNCALIBRATED, HeldOut
from brushloop.calibrate.report import (
    BLUE,
    ORANGE,
    Point,
    about,
    dress,
    ink_uri,
    plot,
    plot_uri,
    recording_facts,
    source_point,
    write_page,
)
from brushloop.calibrate.stats import CEILING, NEAR_POINTS, is_near
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.model.outline import Outline
from brushloop.model.similarity import csim

MAX_CELLS = 48
MARGIN_MM = 1.5
SMOOTH_POINTS = 24
COLOURS = (BLUE, ORANGE, "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
"""Of Okabe and Ito, one for each tilt in turn."""


def write_fit_page(
    captures: Captures, press: FittedPress, sizes: Sequence[Size], held_out: Sequence[HeldOut], path: Path
) -> Path:
    """Write the page of the fit at `path` beside it; returns the page's path. Raises OSError."""
    session = captures.session
    header = session.header
    frame = about(header)
    cells = by_cell(captures.strokes)
    published = FittedPress(captures.radius_mm, captures.length_mm)
    step = max(1, -(-len(cells) // MAX_CELLS))
    return write_page(
        path.with_suffix(".html"),
        "fit.html.j2",
        **frame,
        session=header.session_id,
        window=_window(captures, (press, published)),
        cells=[_cell(cell, cells[cell], press, published, captures.grid) for cell in list(cells)[::step]],
        left_out=len(cells) - len(range(0, len(cells), step)),
        verdict=list(_verdict(captures, held_out)),
        trust=[source_point(header.source), *_trust(captures, held_out)],
        sizes=_sizes(captures, press, frame["label"]),
        measured=sizes,
        middle="{:g} mm, {:g}°".format(*middle(captures.strokes)),
        held_out=held_out,
        refused=captures.refused,
        facts=[
            *recording_facts(header, session.recording.path.name, session.sha256, session.calibration),
            ("images", f"{captures.grid.px_mm:g} mm per pixel"),
            ("fitted with", made_by()),
            ("artefact", path.name),
        ],
    )


def _window(captures: Captures, presses: tuple[FittedPress, ...]) -> tuple[float, float, float, float]:
    """The (left, top, width, height) in mm, y downward, that holds all ink and every outline."""
    grid = captures.grid
    inked = np.any([stroke.ink > 0.5 for stroke in captures.strokes], axis=0)
    x, y = grid.x_mm[inked.any(axis=0)], -grid.y_mm[inked.any(axis=1)]
    low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
    for loop in (_outline(press, cell) for press in presses for cell in by_cell(captures.strokes)):
        if loop is not None:
            points = loop.points.reshape(-1, 2) * np.array([1.0, -1.0])
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    (left, top), (width, height) = (low - MARGIN_MM).tolist(), (high - low + 2.0 * MARGIN_MM).tolist()
    return round(left, 3), round(top, 3), round(width, 3), round(height, 3)


def _cell(cell: Cell, strokes: list[Pressed], press: FittedPress, published: FittedPress, grid: Grid) -> dict[str, Any]:
    """One picture: the mean ink of the cell's presses, and both outlines as SVG paths in mm."""
    mean = np.mean([stroke.ink for stroke in strokes], axis=0).astype(np.float32)
    left, top = float(grid.x_mm[0]) - 0.5 * grid.px_mm, -float(grid.y_mm[0]) - 0.5 * grid.px_mm
    across, down = len(grid.x_mm) * grid.px_mm, len(grid.y_mm) * grid.px_mm
    return {
        "depth_mm": f"{cell[0]:g}",
        "tilt_deg": f"{cell[1]:g}",
        "presses": len(strokes),
        "ink": ink_uri(mean),
        "place": (round(left, 3), round(top, 3), round(across, 3), round(down, 3)),
        "fitted": _path(press, cell),
        "published": _path(published, cell),
        "csim": _csim(press, cell, strokes, grid),
    }


def _csim(press: FittedPress, cell: Cell, strokes: list[Pressed], grid: Grid) -> str:
    """Average CSIM of the fit and the presses that it was fitted to, percent; empty where it draws no mark."""
    try:
        drawn = np.asarray(press.chance(*cell, grid.x_mm, grid.y_mm, SPREAD_MM) > 0.5, np.float32)
    except DomainError:
        return ""
    if not drawn.any():
        return ""
    seen = [np.asarray(stroke.ink > 0.5, np.float32) for stroke in strokes]
    return f"{100.0 * np.mean([csim(drawn, image) for image in seen if image.any()]):.1f}"


def _outline(press: FittedPress, cell: Cell) -> Outline | None:
    try:
        return press.outline(*cell)
    except DomainError:  # so light that the brush leaves no mark
        return None


def _path(press: FittedPress, cell: Cell) -> str:
    """The outline as an SVG path, x to the right and y downward in mm; empty where the brush leaves no mark."""
    loop = _outline(press, cell)
    if loop is None:
        return ""
    points = np.round(np.asarray(loop.points[0], np.float64) * [1.0, -1.0], 2)
    x, y = points[0, 0].tolist()
    curves = "".join(f"Q{a:g} {b:g} {c:g} {d:g}" for (a, b), (c, d) in points[:, 1:].tolist())
    return f"M{x:g} {y:g}{curves}Z"


def _sizes(captures: Captures, press: FittedPress, label: str) -> str:
    """Length and width against depth: the ink of each press as a point, the fit as a line for each tilt."""
    figure, axes = plot(1, 2, (10.0, 3.6))
    strokes, grid = captures.strokes, captures.grid
    heights = np.linspace(min(s.depth_mm for s in strokes), max(s.depth_mm for s in strokes), SMOOTH_POINTS)
    tilts = sorted({stroke.tilt_deg for stroke in strokes})
    shown = tilts if len(tilts) <= len(COLOURS) else [tilts[0], tilts[len(tilts) // 2], tilts[-1]]
    for tilt, colour in zip(shown, COLOURS, strict=False):
        pressed = [(s.depth_mm, *measure(s, grid)) for s in strokes if s.tilt_deg == tilt]
        seen = np.array(
            [(height, toward_tip + toward_heel, width) for height, toward_tip, toward_heel, width in pressed]
        )
        drawn = np.array([_fitted_sizes(press, height, tilt, grid.x_mm) for height in heights])
        for axis, column in zip(axes, (0, 1), strict=True):
            axis.plot(seen[:, 0], seen[:, 1 + column], "o", ms=4, alpha=0.7, color=colour)
            axis.plot(heights, drawn[:, column], color=colour, lw=1.5, label=f"α {tilt:g}°")
    for axis, what in zip(axes, ("length", "width"), strict=True):
        dress(axis, f"{what} ({label})", "commanded depth H, mm", f"{what} of the mark, mm")
    axes[0].legend()
    return plot_uri(figure)


def _fitted_sizes(press: FittedPress, depth_mm: float, tilt_deg: float, x_mm: Floats) -> tuple[float, float]:
    try:
        sizes = press.sizes(depth_mm, tilt_deg)
        width = np.maximum(press.edges_at(depth_mm, tilt_deg, x_mm), 0.0).sum(axis=0).max()
    except DomainError:
        return float("nan"), float("nan")
    return float(sizes.tip + sizes.heel), float(width)


def _verdict(captures: Captures, held_out: Sequence[HeldOut]) -> Iterator[str]:
    brush = captures.session.header.brush or "a brush without a name"
    presses, cells = len(captures.strokes), len(by_cell(captures.strokes))
    yield f"The stroke model was fitted to {presses} presses at {cells} combinations of H and α: {brush}."
    scores = {row.model: row.csim for row in held_out}
    if FITTED not in scores:
        yield "Only one combination was pressed, so how well it predicts others is not known."
        return
    ceiling = f"; a perfect model would reach {scores[CEILING]:.1f} %" if CEILING in scores else ""
    yield (
        f"On combinations that were left out of the fit it predicts the ink with a CSIM of {scores[FITTED]:.1f} %, "
        f"the model as published with {scores[UNCALIBRATED]:.1f} %{ceiling}."
    )


def _trust(captures: Captures, held_out: Sequence[HeldOut]) -> Iterator[Point]:
    below = {row.model: row.below for row in held_out}
    if not below:
        yield Point(False, "One combination of H and α does not show how the mark changes with depth or tilt.")
    elif (off := below.get(FITTED)) is not None:
        span = "" if off.avg_interval is None else " (95 % {:.1f} to {:.1f})".format(*off.avg_interval)
        words = f"Held out, the fit is {off.avg:.1f} points of CSIM{span} below the ceiling"
        yield Point(is_near(off.avg, off.avg_interval), f"{words}; {NEAR_POINTS:g} or less is near.")
    else:
        yield Point(None, "No combination was pressed twice, so the repeatability of the brush is not known here.")
    if captures.refused:
        yield Point(False, f"{len(captures.refused)} presses could not be used; each is named below.")
    else:
        yield Point(True, "Every press was used.")
    yield Point(None, "The pictures above show presses that were fitted; judge the fit by the held-out scores.")
