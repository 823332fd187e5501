"""Drags of a session: found in their photographs, measured, and laid with their commanded paths on one grid.

The protocol in a recording holds the trajectories that were drawn. Imported photographs come with numbers:
`length_mm` along x from the start, a depth (`depth_mm`, ...), and optionally `bend_mm` (the distance of both inner
control points of a cubic Bezier curve to the left of the line) and the depth at both ends, reached from the middle
over a third of the length: `depth_ends_mm`, or `z_frac_ends`, as a share of the travel like `z_frac_mid`.

A stroke with a defect (torn into parts, hollow, under glare) is still used. Its parts lie farther apart than drops
beside a press, so more of them are taken for the stroke. A press model does not predict a drag. Both depend on how wide
the brush opens at a depth, so the fitted slope of width against depth can be compared with the one that CCD-BSM gives.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import prepare_cell
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.session import open_session
from brushloop.calibrate.stats import Line, fit_line
from brushloop.calibrate.stroke.params import PX_PER_MM, Gray, Mask, Params
from brushloop.calibrate.stroke.preprocess import (
    Measured,
    Prepared,
    components,
    fill_holes,
    measure,
    outline,
    preprocess,
    touches_edge,
)
from brushloop.calibrate.stroke.rectify import on_raster, rescale
from brushloop.model.drag import Drawings, Floats
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Header, Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

MARGIN_MM = 16.0
"""Margin around an imported stroke's path: wider than any mark."""
NODES = 28
LENGTH_NAME = "length_mm"
DEPTH_NAMES = ("depth_mm", "depth_mid_mm", "depth_mid_mm_nominal")
COMMANDS = (LENGTH_NAME, "bend_mm", "depth_mm", "depth_ends_mm", "tilt_deg")
ENDS, SHARE_ENDS, SHARE_MID = "depth_ends_mm", "z_frac_ends", "z_frac_mid"
JOIN_MM = 6.0
"""Parts this close to the stroke belong to it."""
TORN_SHARE = 0.03
"""Share of the ink outside the largest part from which a stroke is torn."""
HOLLOW_SHARE = 0.75
"""Share of its outline that ink covers, below which a stroke is hollow: dry bristles, or glare on wet ink."""
FLAGGED_WEIGHT = 0.3
"""Weight in a fit of a stroke with any of these defects: its shape says less about the brush."""
THUMB_PX = 160
OUTLINE_GRAY = 128
LEVEL_DEG = 20.0
"""Bent strokes along x have a rectangle that is a little tilted: only strokes of another direction are turned."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """The usable drags of a session, or the figures that were drawn in it."""

    header: Header
    recording_sha256: str
    calibration: Calibration | None
    drawings: Drawings
    stroke_ids: list[str]
    refused: list[tuple[str, str]]
    """(stroke, why): captures that cannot be used, or that are cut by the edge of their photograph."""
    commands: Floats | None
    """(B, 5) `COMMANDS` of imported strokes; None for figures, which no five numbers describe."""
    flags: list[tuple[str, ...]]
    """Defects of each image, as `defects` words them."""
    ends: str
    """The column that gave the depth at the ends; empty where there was none."""

    @property
    def conditions(self) -> NDArray[np.int64]:
        """(B,) number of each image's condition: its command, or the paths of its figure."""
        groups, paths = self.drawings.groups, self.drawings.paths
        commands = np.zeros((len(groups) - 1, 0)) if self.commands is None else self.commands
        keys = [
            b"".join(values.tobytes() for values in (command, *paths[begin:end]))
            for command, begin, end in zip(commands, groups, groups[1:], strict=False)
        ]
        return np.unique(keys, return_inverse=True)[1]

    @property
    def mm_per_px(self) -> float:
        """The pixel's side."""
        return float(self.drawings.x_mm[1] - self.drawings.x_mm[0])


def read_drags(
    session: Path, mm_per_px: float, calibration_path: Path | None = None, progress: Progress = unseen
) -> Drawn:
    """Read every usable drag or drawn figure. Raises `CalibrationError` if a session holds none, or presses."""
    opened = open_session(session, calibration_path, "drag")
    recording, strokes, calibration = opened.recording, opened.strokes, opened.calibration
    where = str(recording.path)
    figures = figures_of(recording.header) if calibration is not None else {}
    ends, travel_mm = _ends(strokes)
    x_mm, y_mm = (
        _grid(strokes, mm_per_px, travel_mm, where) if calibration is None else _patch_grid(strokes, mm_per_px, where)
    )
    paths: list[Floats] = []
    groups, commands = [0], list[tuple[float, ...]]()
    flags, images, names = list[tuple[str, ...]](), list[NDArray[np.float32]](), list[str]()
    refused: list[tuple[str, str]] = []
    for capture in counted(recording.captures(), "drags read", len(strokes), progress):
        try:
            if calibration is not None:
                drawn, mask, found = *_figure(capture, calibration, figures), ()
            else:
                command = command_of(capture.stroke, travel_mm)
                drawn, (mask, found) = [commanded_path(*command[:4])], _photograph(capture, x_mm, y_mm)
                commands.append(command)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((capture.stroke.stroke_id, error.what))
            continue
        paths += drawn
        groups.append(len(paths))
        size = (len(x_mm), len(y_mm))
        images.append(np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32))
        flags.append(found)
        names.append(capture.stroke.stroke_id)
    if not images:
        raise CalibrationError(where, f"holds no usable stroke: {refused[0][0]}: {refused[0][1]}")
    weights = np.array([_weight(found) for found in flags])
    drawings = Drawings(paths, np.array(groups), np.array(images), x_mm, y_mm, weights)
    known = np.array(commands) if commands else None
    return Drawn(recording.header, opened.sha256, calibration, drawings, names, refused, known, flags, ends)


def figures_of(header: Header) -> dict[str, list[Floats]]:
    """The strokes (n, 4) of each figure of the recorded protocol. Raises `CalibrationError`."""
    try:
        protocol: dict[str, Any] = json.loads(header.protocol)
        return {
            str(figure["name"]): [
                np.array([[float(x), float(y), float(h), float(d)] for x, y, h, _, d in stroke["points"]])
                for stroke in figure["strokes"]
            ]
            for figure in protocol["figures"]
        }
    except (ValueError, KeyError, TypeError) as error:
        problem = f"its recorded protocol holds no trajectories ({error})"
        raise CalibrationError(header.session_id, problem) from None


def commanded_path(length_mm: float, bend_mm: float, depth_mm: float, depth_ends_mm: float) -> Floats:
    """(28, 4) path of an imported stroke that starts at (0, 0)."""
    t = np.linspace(0.0, 1.0, NODES)
    depth = np.interp(t, [0.0, 1 / 3, 2 / 3, 1.0], [depth_ends_mm, depth_mm, depth_mm, depth_ends_mm])
    return np.column_stack([length_mm * t, 3.0 * bend_mm * t * (1.0 - t), depth, np.zeros(NODES)])


def command_of(stroke: Stroke, travel_mm: float | None) -> tuple[float, float, float, float, float]:
    """`COMMANDS` of an imported stroke; the depth at the ends is that of the middle where the table has none.

    Raises `CaptureRefused` without length or depth.
    """
    commanded, depth = dict(stroke.commanded), depth_of(stroke)
    if LENGTH_NAME not in commanded or depth is None:
        raise CaptureRefused(stroke.stroke_id, f"has no {LENGTH_NAME} or no depth")
    ends = commanded.get(ENDS)
    if ends is None:
        share = commanded.get(SHARE_ENDS)
        ends = depth if share is None or travel_mm is None else share * travel_mm
    return commanded[LENGTH_NAME], commanded.get("bend_mm", 0.0), depth, ends, stroke.tilt_deg or 0.0


def depth_of(stroke: Stroke) -> float | None:
    """The commanded depth of a stroke, mm, under whichever name its table gives it."""
    if stroke.depth_mm is not None:
        return stroke.depth_mm
    commanded = dict(stroke.commanded)
    return next((commanded[name] for name in DEPTH_NAMES if name in commanded), None)


def _ends(strokes: Sequence[Stroke]) -> tuple[str, float | None]:
    """The column that gives the depth at the ends, and the travel in mm of which it is a share."""
    if any(ENDS in dict(stroke.commanded) for stroke in strokes):
        return ENDS, None
    travels: list[float] = []
    for stroke in strokes:
        commanded = dict(stroke.commanded)
        depth, share = depth_of(stroke), commanded.get(SHARE_MID, 0.0)
        if depth is not None and share > 0.0 and SHARE_ENDS in commanded:
            travels.append(depth / share)
    return (SHARE_ENDS, float(np.median(travels))) if travels else ("", None)


def _figure(capture: Capture, calibration: Calibration, figures: dict[str, list[Floats]]) -> tuple[list[Floats], Mask]:
    stroke = capture.stroke
    paths = figures.get(stroke.stroke_id.rpartition("-r")[0])
    if paths is None:
        raise CaptureRefused(stroke.stroke_id, "is not a figure of the recorded protocol")
    if any(len(path) < 2 for path in paths):
        raise CaptureRefused(stroke.stroke_id, "has a stroke with only one point")
    prepared = prepare_cell(capture, calibration)
    if prepared.cut:
        raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph or cell")
    return paths, prepared.mask


def _photograph(capture: Capture, x_mm: Floats, y_mm: Floats) -> tuple[Mask, tuple[str, ...]]:
    """A stroke's ink, cropped to the grid, and its defects."""
    stroke = capture.stroke
    if stroke.px_per_mm is None or stroke.anchor_px is None:
        raise CaptureRefused(stroke.stroke_id, "has no scale or no start (start_x_px, start_y_px)")
    anchor = on_raster(stroke.anchor_px, stroke.px_per_mm)
    raster = rescale(capture.image(), stroke.px_per_mm, capture.where)
    prepared, whole, flags = prepare_drag(raster, anchor, capture.where, Params())
    if prepared.cut:
        raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph")
    half = 0.5 * float(x_mm[1] - x_mm[0])
    left = round(anchor[0] + (x_mm[0] - half) * PX_PER_MM)
    top = round(anchor[1] - (y_mm[0] + half) * PX_PER_MM)
    height, width = (round(2 * half * len(axis) * PX_PER_MM) for axis in (y_mm, x_mm))
    pad = max(height, width) + abs(left) + abs(top)
    return np.pad(whole, pad)[top + pad : top + pad + height, left + pad : left + pad + width], flags


def prepare_drag(
    raster: Gray, anchor_px: tuple[float, float] | None, where: str, params: Params
) -> tuple[Prepared, Mask, tuple[str, ...]]:
    """Find a drag on its raster: its connected part, all parts of it, and its defects. It is cut if any part is.

    Raises `CaptureRefused` as `prepare` does.
    """
    steps = preprocess(raster, anchor_px, where, params)
    wide = replace(params, join_mm=max(params.join_mm, JOIN_MM))
    whole = fill_holes(components(steps.ink, anchor_px, wide).mask, params)
    glare = tuple(flag for flag in steps.prepared.flags if flag.startswith("glare"))
    return replace(steps.prepared, cut=touches_edge(whole)), whole, (*defects(whole), *glare)


def defects(mask: Mask) -> tuple[str, ...]:
    """Describe what is wrong with a stroke's ink, one phrase for each defect; empty for a sound stroke."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    ink = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    count, _, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.float64)
    found: list[str] = []
    if areas.max() < (1.0 - TORN_SHARE) * areas.sum():
        found.append(f"torn: {count - 1} parts, the largest holds {100 * areas.max() / areas.sum():.0f} % of the ink")
    covered = float(np.count_nonzero(ink)) / float(np.count_nonzero(outline(ink)))
    if covered < HOLLOW_SHARE:
        found.append(f"hollow: ink covers {100 * covered:.0f} % of the outline")
    return tuple(found)


def _patch_grid(strokes: Sequence[Stroke], mm_per_px: float, where: str) -> tuple[Floats, Floats]:
    sizes = {stroke.cell_mm[2:] for stroke in strokes if stroke.cell_mm is not None}
    if len(sizes) != 1:
        raise CalibrationError(where, "its figures have no cells, or cells of several sizes")
    [(size_x_mm, size_y_mm)] = sizes
    columns, rows = round(size_x_mm / mm_per_px), round(size_y_mm / mm_per_px)
    x_mm = (np.arange(columns) + 0.5) * size_x_mm / columns
    return x_mm, size_y_mm - (np.arange(rows) + 0.5) * size_y_mm / rows


def _grid(strokes: Sequence[Stroke], mm_per_px: float, travel_mm: float | None, where: str) -> tuple[Floats, Floats]:
    paths: list[Floats] = []
    for stroke in strokes:
        with contextlib.suppress(CaptureRefused):
            paths.append(commanded_path(*command_of(stroke, travel_mm)[:4]))
    if not paths:
        raise CalibrationError(where, f"no stroke has {LENGTH_NAME} and a depth: its path is unknown")
    places = np.concatenate(paths)
    # Pixel k covers [k, k + 1) mm_per_px in every session, so that one session's ink lies on the other's grid.
    left, low = (int(k) for k in np.floor((places[:, :2].min(axis=0) - MARGIN_MM) / mm_per_px))
    right, high = (int(k) for k in np.ceil((places[:, :2].max(axis=0) + MARGIN_MM) / mm_per_px))
    x_mm, y_mm = (np.arange(left, right) + 0.5) * mm_per_px, (np.arange(high, low, -1) - 0.5) * mm_per_px
    return np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64)


@dataclass(frozen=True, slots=True)
class Drag:
    """One drag, with its commanded and measured values."""

    stroke_id: str
    commanded: dict[str, float]
    depth_mm: float | None
    """The commanded depth, under whichever name the source gives it."""
    measured: Measured
    cut: bool
    """True where the photograph cuts the stroke."""
    flags: tuple[str, ...]
    """Defects, as `defects` words them."""
    thumbnail: Gray
    """(160, 160) gray photograph with the stroke's outline drawn in."""


@dataclass(frozen=True, slots=True)
class DragResults:
    """The measured drags of a session, and (stroke, why) of those that cannot be measured."""

    strokes: list[Drag]
    refused: list[tuple[str, str]]

    @property
    def width_on_depth(self) -> Line | None:
        """Width at the middle on commanded depth."""
        return self._line([(drag, drag.depth_mm, drag.measured.mid_width_mm) for drag in self.strokes])

    @property
    def length_on_commanded(self) -> Line | None:
        """Measured length on commanded length."""
        return self._line([(drag, drag.commanded.get(LENGTH_NAME), drag.measured.length_mm) for drag in self.strokes])

    @staticmethod
    def _line(points: list[tuple[Drag, float | None, float]]) -> Line | None:
        """A line through the strokes that are not cut; those with a defect count less, as in a fit."""
        whole = [
            (x, y, FLAGGED_WEIGHT if drag.flags else 1.0) for drag, x, y in points if x is not None and not drag.cut
        ]
        return fit_line(*(list(column) for column in zip(*whole, strict=True))) if whole else None


def _weight(flags: tuple[str, ...]) -> float:
    return FLAGGED_WEIGHT if flags else 1.0


def measure_drags(captures: Iterable[Capture], params: Params) -> DragResults:
    """Measure every stroke."""
    results = DragResults([], [])
    for capture in captures:
        try:
            results.strokes.append(_measure(capture, params))
        except (CaptureRefused, SessionDamaged) as error:
            results.refused.append((capture.stroke.stroke_id, error.what))
    return results


def _measure(capture: Capture, params: Params) -> Drag:
    stroke = capture.stroke
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has no scale (px_per_mm)")
    raster = rescale(capture.image(), stroke.px_per_mm, capture.where)
    anchor = on_raster(stroke.anchor_px, stroke.px_per_mm) if stroke.anchor_px is not None else None
    prepared, _, flags = prepare_drag(raster, anchor, capture.where, params)
    named = {"depth_mm": stroke.depth_mm, "tilt_deg": stroke.tilt_deg}
    commanded = dict(stroke.commanded) | {name: value for name, value in named.items() if value is not None}
    # A start in the table means a commanded path, which runs along x. Scanned strokes have neither.
    size = measure(along_axis(prepared.mask) if anchor is None else prepared.mask)
    thumbnail = _thumbnail(raster, prepared.mask)
    return Drag(stroke.stroke_id, commanded, depth_of(stroke), size, prepared.cut, flags, thumbnail)


def along_axis(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask turned until the stroke's longer axis, that of its smallest enclosing rectangle, is the x axis.

    A mask whose axis is within `LEVEL_DEG` of x is returned as it is.
    """
    points = cv2.findNonZero(mask.astype(np.uint8))
    centre, (width, height), angle = cv2.minAreaRect(points)
    turn = angle if width >= height else angle - 90.0
    turn = (turn + 90.0) % 180.0 - 90.0
    if abs(turn) < LEVEL_DEG:
        return mask
    side = int(np.hypot(*mask.shape)) + 2
    matrix = cv2.getRotationMatrix2D(centre, turn, 1.0)
    matrix[:, 2] += 0.5 * side - np.array(centre)
    turned = cv2.warpAffine(255 * mask.astype(np.uint8), matrix, (side, side), flags=cv2.INTER_LINEAR)
    return np.asarray(turned > 127, np.bool_)


def _thumbnail(raster: Gray, mask: Mask) -> Gray:
    """A square around the stroke, with its outline drawn in."""
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    side = round(1.15 * max(width, height)) + 8
    # Padded by `side`, so that a square of that size around the stroke always fits.
    rows, columns = (slice(start, start + side) for start in (y + (height + side) // 2, x + (width + side) // 2))
    small, inside = (
        cv2.resize(padded[rows, columns], (THUMB_PX, THUMB_PX), interpolation=cv2.INTER_AREA)
        for padded in (np.pad(raster, side, mode="edge"), np.pad(mask.astype(np.uint8), side))
    )
    outlines, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(small, outlines, -1, OUTLINE_GRAY), np.uint8)
