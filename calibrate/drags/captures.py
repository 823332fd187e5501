"""Drags of a session as commanded paths with their captured ink, for `calibrate.drags.fit`.

The protocol in a recording holds the trajectories that were drawn. Imported photographs come with numbers:
`length_mm` along x from the start, a depth (`depth_mm`, ...), and optionally `bend_mm` (the distance of both inner
control points of a cubic Bezier curve to the left of the line) and the depth at both ends, reached from the middle
over a third of the length: `depth_ends_mm`, or `z_frac_ends`, as a share of the travel like `z_frac_mid`.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import prepare_cell
from brushloop.calibrate.drags.measure import FLAGGED_WEIGHT, LENGTH_NAME, depth_of, prepare_drag
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stroke.params import PX_PER_MM, Params
from brushloop.calibrate.stroke.rectify import on_raster, rescale
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Header, Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

Floats = NDArray[np.float64]
MARGIN_MM = 16.0
"""Margin around an imported stroke's path: wider than any mark."""
NODES = 28
COMMANDS = ("length_mm", "bend_mm", "depth_mm", "depth_ends_mm", "tilt_deg")
ENDS, SHARE_ENDS, SHARE_MID = "depth_ends_mm", "z_frac_ends", "z_frac_mid"


@dataclass(frozen=True, slots=True)
class Drawn:
    """Drags on one grid of pixel centres, mm, y upward."""

    header: Header
    recording_sha256: str
    calibration: Calibration | None
    x_mm: Floats
    y_mm: Floats
    paths: list[Floats]
    """The paths of all images in order, (n, 4) each: x, y, depth in mm, heading in deg."""
    groups: NDArray[np.int64]
    """(B + 1,): paths `groups[i]` to `groups[i + 1]` are the strokes of image i."""
    ink: NDArray[np.float32]
    """(B, len(y_mm), len(x_mm)) from 0 to 1."""
    stroke_ids: list[str]
    refused: list[tuple[str, str]]
    """(stroke, why): captures that cannot be used, or that are cut by the edge of their photograph."""
    commands: Floats | None
    """(B, 5) `COMMANDS` of imported strokes; None for figures, which no five numbers describe."""
    flags: list[tuple[str, ...]]
    """Defects of each image (`calibrate.drags.measure.defects`)."""
    ends: str
    """The column that gave the depth at the ends; empty where there was none."""

    @property
    def weights(self) -> Floats:
        """(B,) weight of each image in a fit: flagged ones count less."""
        return np.array([FLAGGED_WEIGHT if flags else 1.0 for flags in self.flags])

    @property
    def conditions(self) -> NDArray[np.int64]:
        """(B,) number of each image's condition: its command, or the paths of its figure."""
        commands = np.zeros((len(self.ink), 0)) if self.commands is None else self.commands
        keys = [
            b"".join(values.tobytes() for values in (command, *self.paths[begin:end]))
            for command, begin, end in zip(commands, self.groups, self.groups[1:], strict=False)
        ]
        return np.unique(keys, return_inverse=True)[1]

    @property
    def mm_per_px(self) -> float:
        """The pixel's side."""
        return float(self.x_mm[1] - self.x_mm[0])


def read_drags(
    session: Path, mm_per_px: float, calibration_path: Path | None = None, progress: Progress = unseen
) -> Drawn:
    """Read every usable drag or drawn figure. Raises `CalibrationError` if a session holds none."""
    recording = Recording(session)
    digest, strokes = recording.sha256, list(recording.stroke_records())
    where = str(recording.path)
    if not strokes or {stroke.kind for stroke in strokes} != {"drag"}:
        raise CalibrationError(where, "holds no drags: fit its presses without --drags")
    calibration = calibration_of(recording, strokes[0], digest, calibration_path)
    figures = figures_of(recording.header) if calibration is not None else {}
    ends, travel_mm = _ends(strokes)
    if calibration is not None:
        x_mm, y_mm = _cell_grid(strokes, mm_per_px, where)
    else:
        x_mm, y_mm = _grid(strokes, mm_per_px, travel_mm, where)
    paths: list[list[Floats]] = []
    commands: list[tuple[float, ...]] = []
    flags: list[tuple[str, ...]] = []
    images: list[NDArray[np.float32]] = []
    names: list[str] = []
    refused: list[tuple[str, str]] = []
    for capture in counted(recording.captures(), "drags read", len(strokes), progress):
        name = capture.stroke.stroke_id
        try:
            if calibration is not None:
                drawn, (image, found) = _figure(capture, calibration, figures, x_mm, y_mm)
            else:
                command = command_of(capture.stroke, travel_mm)
                drawn, (image, found) = [commanded_path(*command[:4])], _photograph(capture, x_mm, y_mm)
                commands.append(command)
        except (CaptureRefused, SessionDamaged) as error:
            refused.append((name, error.what))
            continue
        paths.append(drawn)
        images.append(image)
        flags.append(found)
        names.append(name)
    if not images:
        raise CalibrationError(where, f"holds no usable stroke: {refused[0][0]}: {refused[0][1]}")
    groups = np.cumsum([0, *(len(one) for one in paths)])
    flat = [path for one in paths for path in one]
    return Drawn(
        recording.header,
        digest,
        calibration,
        x_mm,
        y_mm,
        flat,
        groups,
        np.array(images),
        names,
        refused,
        np.array(commands) if commands else None,
        flags,
        ends,
    )


def figures_of(header: Header) -> dict[str, list[Floats]]:
    """Map each figure to its strokes, (n, 4) in cell coordinates, from the protocol. Raises `CalibrationError`."""
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
    commanded = dict(stroke.commanded)
    depth = depth_of(stroke)
    if LENGTH_NAME not in commanded or depth is None:
        raise CaptureRefused(stroke.stroke_id, f"has no {LENGTH_NAME} or no depth")
    ends = commanded.get(ENDS)
    if ends is None:
        share = commanded.get(SHARE_ENDS)
        ends = depth if share is None or travel_mm is None else share * travel_mm
    return commanded[LENGTH_NAME], commanded.get("bend_mm", 0.0), depth, ends, stroke.tilt_deg or 0.0


def _ends(strokes: list[Stroke]) -> tuple[str, float | None]:
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


def _figure(
    capture: Capture, calibration: Calibration, figures: dict[str, list[Floats]], x_mm: Floats, y_mm: Floats
) -> tuple[list[Floats], tuple[NDArray[np.float32], tuple[str, ...]]]:
    stroke = capture.stroke
    paths = figures.get(stroke.stroke_id.rpartition("-r")[0])
    if paths is None:
        raise CaptureRefused(stroke.stroke_id, "is not a figure of the recorded protocol")
    if any(len(path) < 2 for path in paths):
        raise CaptureRefused(stroke.stroke_id, "has a stroke with only one point")
    prepared = prepare_cell(capture, calibration)
    if prepared.cut:
        raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph or cell")
    return paths, (_shrunk(prepared.mask, x_mm, y_mm), ())


def _photograph(capture: Capture, x_mm: Floats, y_mm: Floats) -> tuple[NDArray[np.float32], tuple[str, ...]]:
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
    mask = np.pad(whole, pad)[top + pad : top + pad + height, left + pad : left + pad + width]
    return _shrunk(mask, x_mm, y_mm), flags


def _shrunk(mask: NDArray[np.bool_], x_mm: Floats, y_mm: Floats) -> NDArray[np.float32]:
    size = (len(x_mm), len(y_mm))
    return np.asarray(cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)


def _cell_grid(strokes: list[Stroke], mm_per_px: float, where: str) -> tuple[Floats, Floats]:
    sizes = {stroke.cell_mm[2:] for stroke in strokes if stroke.cell_mm is not None}
    if len(sizes) != 1:
        raise CalibrationError(where, "its figures have no cells, or cells of several sizes")
    [(size_x_mm, size_y_mm)] = sizes
    columns, rows = round(size_x_mm / mm_per_px), round(size_y_mm / mm_per_px)
    x_mm = (np.arange(columns) + 0.5) * size_x_mm / columns
    return x_mm, size_y_mm - (np.arange(rows) + 0.5) * size_y_mm / rows


def _grid(strokes: list[Stroke], mm_per_px: float, travel_mm: float | None, where: str) -> tuple[Floats, Floats]:
    paths = list(_paths(strokes, travel_mm))
    if not paths:
        raise CalibrationError(where, f"no stroke has {LENGTH_NAME} and a depth: its path is unknown")
    places = np.concatenate(paths)
    # Pixel k covers [k, k + 1) mm_per_px in every session, so that one session's ink lies on the other's grid.
    left, low = (int(k) for k in np.floor((places[:, :2].min(axis=0) - MARGIN_MM) / mm_per_px))
    right, high = (int(k) for k in np.ceil((places[:, :2].max(axis=0) + MARGIN_MM) / mm_per_px))
    x_mm, y_mm = (np.arange(left, right) + 0.5) * mm_per_px, (np.arange(high, low, -1) - 0.5) * mm_per_px
    return np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64)


def _paths(strokes: list[Stroke], travel_mm: float | None) -> Iterator[Floats]:
    for stroke in strokes:
        try:
            yield commanded_path(*command_of(stroke, travel_mm)[:4])
        except CaptureRefused:
            continue
