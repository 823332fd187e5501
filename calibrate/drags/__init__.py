"""Drags of an imported session: found in their photographs, measured, and their ink laid on one grid.

Photographs come with a table: `length_mm` along x from the start, a depth (`depth_mm`, ...), and optionally `bend_mm`
(the distance of both inner control points of a cubic Bezier curve to the left of the line) and the depth at both ends,
reached from the middle over a third of the length: `depth_ends_mm`, or `z_frac_ends`, as a share of the travel like
`z_frac_mid`.

A stroke with a defect (torn into parts, hollow, under glare) is measured and predicted, but no brush is fitted to it.
Parts of a drag lie farther apart than drops beside a press, so more of them are taken for the stroke.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.presses import Refused, rectified
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Gray, Measured, components, measure, outline, touches_edge
from brushloop.model.drag import Drawings, Floats
from brushloop.model.similarity import inked_window
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

MM_PER_PX = 0.4
"""Scale of the grid."""
MARGIN_MM = 16.0
"""Margin around a stroke's path: wider than any mark."""
NODES = 28
COMMANDS = ("length_mm", "bend_mm", "depth_mm", "depth_ends_mm", "tilt_deg")
ENDS, SHARE_ENDS, SHARE_MID = "depth_ends_mm", "z_frac_ends", "z_frac_mid"
JOIN_MM = 6.0
"""Parts this close to the stroke belong to it."""
TORN_SHARE = 0.03
"""Share of the ink outside the largest part from which a stroke is torn."""
HOLLOW_SHARE = 0.75
"""Share of its outline that ink covers, below which a stroke is hollow: dry bristles, or glare on wet ink."""
THUMB_PX = 160
OUTLINE_GRAY = 128
LEVEL_DEG = 20.0
"""Bent strokes along x have a rectangle that is a little tilted: only strokes of another direction are turned."""


@dataclass(frozen=True, slots=True)
class Drag:
    """One drag: what was commanded, and what its photograph shows."""

    stroke: Stroke
    command: tuple[float, ...] | None
    """`COMMANDS`; None where the table gives no length or no depth."""
    measured: Measured
    cut: bool
    """True where the photograph cuts the stroke."""
    flags: tuple[str, ...]
    """Defects, as `defects` words them."""
    thumbnail: Gray
    """(160, 160) gray photograph with the stroke's outline drawn in."""
    ink: NDArray[np.float32] | None
    """(len(y_mm), len(x_mm)) from 0 to 1 on the grid of the session; None where its place there is not known."""

    @property
    def why_left_out(self) -> str:
        """The reason why the stroke can be measured, but neither fitted nor predicted; empty if it can."""
        if self.cut:
            return "is cut by the edge of its photograph"
        return "" if self.ink is not None else "lacks its length_mm, depth or start (start_x_px, start_y_px)"


@dataclass(frozen=True)
class Drags:
    """The measured drags of a session. Those whose path is known and which are not cut are `placed` on one grid."""

    session: OpenSession
    strokes: list[Drag]
    refused: list[Refused]
    """Those that cannot be measured."""
    grid: tuple[Floats, Floats]
    """x from the start of the strokes and y of pixel centres, mm; empty where no stroke's path is known."""
    ends: str
    """The column that gave the depth at the ends; empty where there was none."""

    @property
    def left_out(self) -> list[Refused]:
        """The strokes that are not `placed`."""
        reasons = ((drag.stroke.stroke_id, drag.why_left_out) for drag in self.strokes)
        return [*self.refused, *(refusal for refusal in reasons if refusal[1])]

    @cached_property
    def placed(self) -> list[Drag]:
        """The strokes that can be fitted or predicted. Raises `CalibrationError` if there is none."""
        placed = [drag for drag in self.strokes if not drag.why_left_out]
        if not placed:
            first = ": {}: {}".format(*self.left_out[0]) if self.left_out else ""
            raise CalibrationError(str(self.session.recording.path), f"holds no stroke with a known path{first}")
        return placed

    @cached_property
    def commands(self) -> Floats:
        """(B, 5) `COMMANDS` of the placed strokes."""
        return np.array([drag.command for drag in self.placed], np.float64)

    @property
    def conditions(self) -> NDArray[np.int64]:
        """(B,) number of each placed stroke's command."""
        return np.unique(self.commands, axis=0, return_inverse=True)[1].ravel()

    @property
    def sound(self) -> NDArray[np.int64]:
        """Positions of the placed strokes without a defect, to which a brush is fitted."""
        return np.flatnonzero([not drag.flags for drag in self.placed])

    @cached_property
    def drawings(self) -> Drawings:
        """The placed strokes."""
        paths = [commanded_path(*command[:4]) for command in self.commands.tolist()]
        return Drawings.of([[path] for path in paths], np.array([drag.ink for drag in self.placed]), *self.grid)

    def widths(self) -> Floats:
        """(n, 2) commanded depth and width at the middle, mm, of strokes that are neither cut nor have a defect."""
        whole = ((depth_of(drag.stroke), drag) for drag in self.strokes if not drag.cut and not drag.flags)
        points = [(depth_mm, drag.measured.mid_width_mm) for depth_mm, drag in whole if depth_mm is not None]
        return np.array(points, np.float64).reshape(-1, 2)


def read_drags(path: Path, progress: Progress = unseen) -> Drags:
    """Read and measure every drag. Raises `CalibrationError` for presses, and for figures that the arm wrote."""
    session = open_session(path, "drag")
    if session.calibration is not None:
        what = "holds figures that the arm wrote: `write fit` fits their brush, `write compare` compares them"
        raise CalibrationError(str(session.recording.path), what)
    ends, travel_mm = _ends(session.strokes)
    grid = _grid([command_of(stroke, travel_mm) for stroke in session.strokes])
    drags = Drags(session, [], [], grid, ends)
    for capture in counted(session.recording.captures(), "drags read", len(session.strokes), progress):
        try:
            drags.strokes.append(_read(capture, command_of(capture.stroke, travel_mm), grid))
        except (CaptureRefused, SessionDamaged) as error:
            drags.refused.append((capture.stroke.stroke_id, error.what))
    return drags


def commanded_path(length_mm: float, bend_mm: float, depth_mm: float, depth_ends_mm: float) -> Floats:
    """(28, 3) path x, y, depth of a stroke that starts at (0, 0)."""
    t = np.linspace(0.0, 1.0, NODES)
    depth = np.interp(t, [0.0, 1 / 3, 2 / 3, 1.0], [depth_ends_mm, depth_mm, depth_mm, depth_ends_mm])
    return np.column_stack([length_mm * t, 3.0 * bend_mm * t * (1.0 - t), depth])


def command_of(stroke: Stroke, travel_mm: float | None) -> tuple[float, ...] | None:
    """`COMMANDS` of a stroke, None without length or depth.

    The depth at the ends is that of the middle where the table has none.
    """
    commanded, depth = stroke.commanded, depth_of(stroke)
    if "length_mm" not in commanded or depth is None:
        return None
    share = commanded.get(SHARE_ENDS)
    ends = commanded.get(ENDS, depth if share is None or travel_mm is None else share * travel_mm)
    return commanded["length_mm"], commanded.get("bend_mm", 0.0), depth, ends, stroke.tilt_deg or 0.0


def depth_of(stroke: Stroke) -> float | None:
    """The commanded depth of a stroke, mm, under either of the names that its table may give it."""
    return stroke.depth_mm if stroke.depth_mm is not None else stroke.commanded.get("depth_mid_mm_nominal")


def _ends(strokes: Sequence[Stroke]) -> tuple[str, float | None]:
    """The column that gives the depth at the ends, and the travel in mm of which it is a share."""
    if any(ENDS in stroke.commanded for stroke in strokes):
        return ENDS, None
    shared = [stroke for stroke in strokes if SHARE_ENDS in stroke.commanded and stroke.commanded.get(SHARE_MID, 0) > 0]
    depths = ((depth_of(stroke), stroke.commanded[SHARE_MID]) for stroke in shared)
    travels_mm = [depth_mm / share for depth_mm, share in depths if depth_mm is not None]
    return (SHARE_ENDS, float(np.median(travels_mm))) if travels_mm else ("", None)


def _grid(commands: Sequence[tuple[float, ...] | None]) -> tuple[Floats, Floats]:
    """Pixel centres of the grid that holds all commanded paths."""
    paths = [commanded_path(*command[:4]) for command in commands if command is not None]
    if not paths:
        return np.zeros(0), np.zeros(0)
    places = np.concatenate(paths)
    # Pixel k covers [k, k + 1) times MM_PER_PX in every session, so that one session's ink lies on the other's grid.
    left, low = (int(k) for k in np.floor((places[:, :2].min(axis=0) - MARGIN_MM) / MM_PER_PX))
    right, high = (int(k) for k in np.ceil((places[:, :2].max(axis=0) + MARGIN_MM) / MM_PER_PX))
    x_mm, y_mm = (np.arange(left, right) + 0.5) * MM_PER_PX, (np.arange(high, low, -1) - 0.5) * MM_PER_PX
    return np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64)


def _read(capture: Capture, command: tuple[float, ...] | None, grid: tuple[Floats, Floats]) -> Drag:
    """Find a drag, all parts of it, and measure its connected part. It is cut if any part is.

    Raises as `rectified` does.
    """
    raster, prepared = rectified(capture, None)
    mask, anchor = prepared.mask, prepared.anchor_px
    whole = components(prepared.ink, anchor, JOIN_MM)[0]
    glare = tuple(flag for flag in prepared.flags if flag.startswith("glare"))
    return Drag(
        capture.stroke,
        command,
        # A start in the table means a commanded path, which runs along x. Scanned strokes have neither.
        measure(along_axis(mask) if anchor is None else mask),
        touches_edge(whole),
        (*defects(whole), *glare),
        _thumbnail(raster, mask),
        None if command is None or anchor is None else _on_grid(whole, anchor, *grid),
    )


def _on_grid(
    mask: NDArray[np.bool_], anchor_px: tuple[float, float], x_mm: Floats, y_mm: Floats
) -> NDArray[np.float32]:
    """The ink of a stroke that starts at `anchor_px` of its raster."""
    step_px = round(MM_PER_PX * PX_PER_MM)
    left = round(anchor_px[0] + x_mm[0] * PX_PER_MM - 0.5 * step_px)
    top = round(anchor_px[1] - y_mm[0] * PX_PER_MM - 0.5 * step_px)
    to_grid, size = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top]]), (len(x_mm), len(y_mm))
    ink = cv2.warpAffine(mask.astype(np.float32), to_grid, (step_px * size[0], step_px * size[1]))
    return np.asarray(cv2.resize(ink, size, interpolation=cv2.INTER_AREA), np.float32)


def defects(mask: NDArray[np.bool_]) -> tuple[str, ...]:
    """Describe what is wrong with a stroke's ink, one phrase for each defect; empty for a sound stroke."""
    ink = mask[inked_window(mask, mask, 0)]
    count, _, stats, _ = cv2.connectedComponentsWithStats(ink.astype(np.uint8), connectivity=8)
    areas = np.asarray(stats[1:, cv2.CC_STAT_AREA], np.float64)
    phrases: list[str] = []
    if areas.max() < (1.0 - TORN_SHARE) * areas.sum():
        phrases.append(f"torn: {count - 1} parts, the largest holds {100 * areas.max() / areas.sum():.0f} % of the ink")
    covered = float(np.count_nonzero(ink)) / float(np.count_nonzero(outline(ink)))
    if covered < HOLLOW_SHARE:
        phrases.append(f"hollow: ink covers {100 * covered:.0f} % of the area inside its outline")
    return tuple(phrases)


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


def _thumbnail(raster: Gray, mask: NDArray[np.bool_]) -> Gray:
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
