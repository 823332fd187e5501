"""From a dragged brush to ink on paper: the contact patch trails the tip on a leash, and is printed at each moment."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from brushloop.drivers.sim.brush.footprint import (
    MARGIN_MM,
    PX_PER_MM,
    Footprint,
    Image,
    Tuft,
    frame_around,
    scatter,
    soak,
)
from brushloop.drivers.sim.brush.mechanics import SpineShape, Vector

STEP_MM = 0.3
"""Longest distance that the commanded tip travels between two moments of a drag."""
SHORTEST = 0.3
"""Length of a patch that is pulled square across, as a share of its full length."""


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point of the commanded tip's path, in the paper frame; depth is positive below the paper plane."""

    x_mm: float
    y_mm: float
    depth_mm: float


@dataclass(frozen=True, slots=True)
class Moment:
    """The patch at one moment of a drag."""

    x_mm: float
    y_mm: float
    """Its middle, in the frame of the path."""
    heading_rad: float
    """Direction from the tip of the hairs to the ferrule."""
    length: float
    """Factor on its length."""
    depth_mm: float
    travel_mm: float
    """Sideways distance that the commanded tip has travelled so far."""
    pulled: bool
    """True once the leash has come taut."""


INK_PER_MM = 0.005
"""Share of a full brush that one mm of a drag uses, on top of what landing uses."""
DEPTH_STEP_MM = 0.2
LOAD_STEP = 0.02
"""Patches of nearly equal depth and load are drawn once."""
WET_MM = 0.3
"""Hairs this near the paper are part of the patch."""
STAMP_MARGIN_MM = 1.5


@dataclass(frozen=True)
class Stances:
    """Shapes of one brush on the paper at each depth: pressed straight down, and dragged. Both start unloaded."""

    pressed: tuple[SpineShape, ...]
    pulled: tuple[SpineShape, ...]
    deepest_mm: float

    def at(self, depth_mm: float, pulled: bool) -> SpineShape:
        """The spine at a depth, between the two nearest that were solved."""
        shapes = self.pulled if pulled else self.pressed
        place = min(depth_mm / self.deepest_mm, 1.0) * (len(shapes) - 1)
        below = min(int(place), len(shapes) - 2)
        return _between(shapes[below], shapes[below + 1], place - below)

    def leash_mm(self, depth_mm: Vector) -> tuple[Vector, Vector, Vector]:
        """How far behind the commanded tip the middle of the patch lies, (n,) each, at depths (n,).

        Returns the distance after a straight descent, the distance while the brush is dragged, which is the length of
        the leash, and half the length of the patch.
        """
        solved_mm = np.linspace(0.0, self.deepest_mm, len(self.pulled))
        pressed, pulled = ([self.at(float(d), p) for d in solved_mm] for p in (False, True))
        return (
            np.interp(depth_mm, solved_mm, [-middle_mm(shape) for shape in pressed]),
            np.interp(depth_mm, solved_mm, [-middle_mm(shape) for shape in pulled]),
            np.interp(depth_mm, solved_mm, [_half_mm(shape) for shape in pulled]),
        )


def _between(a: SpineShape, b: SpineShape, share: float) -> SpineShape:
    """The spine a share of the way from one to the other."""
    pairs = ((getattr(a, field.name), getattr(b, field.name)) for field in fields(SpineShape))
    return SpineShape(*(near + share * (far - near) for near, far in pairs))


def middle_mm(shape: SpineShape) -> float:
    """Mean x of a spine's contact with the paper, weighted by force; the x of its tip if it does not touch."""
    force = float(shape.normal_n.sum())
    return float(shape.x_mm @ shape.normal_n) / force if force > 1e-6 else float(shape.x_mm[-1])


def _half_mm(shape: SpineShape) -> float:
    """Half the length of the part of a spine that is near enough to the paper to wet it."""
    near = shape.x_mm[shape.squash_mm > -WET_MM]
    return 0.5 * float(near.max() - near.min()) if near.size else 0.0


def follow(path: Sequence[Waypoint], stances: Stances, heading_rad: float) -> list[Moment]:
    """Draw the patch along the path on its leash.

    While the brush comes down, its tip slides away from the ferrule and takes the middle of the patch along. The patch
    stays where it is until the leash is taut, then follows straight toward the commanded tip. It turns like a stick
    that is pulled at its middle, over half its own length; pulled across, the hairs stand up and the patch is short.
    """
    x, y, depth = _samples(path)
    pressed, pulled, half = stances.leash_mm(depth)
    travel = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    px, py = float(x[0]), float(y[0])
    heading, taut = heading_rad, False
    moments: list[Moment] = []
    for k in range(x.size):
        slid = float(pressed[k] - (pressed[k - 1] if k else 0.0))
        if k == 0 or depth[k] > depth[k - 1]:
            px -= slid * math.cos(heading)
            py -= slid * math.sin(heading)
        dx, dy = float(x[k]) - px, float(y[k]) - py
        short, askew = math.hypot(dx, dy) - float(pulled[k]), 0.0
        if short > 0.0:
            toward = math.atan2(dy, dx)
            px += short * math.cos(toward)
            py += short * math.sin(toward)
            askew = math.remainder(toward - heading, math.tau) * math.exp(-short / max(float(half[k]), STEP_MM))
            heading, taut = toward - askew, True
        length = max(SHORTEST, abs(math.cos(askew)))
        moments.append(Moment(px, py, heading, length, float(depth[k]), float(travel[k]), taut))
    return moments


def _samples(path: Sequence[Waypoint]) -> tuple[Vector, Vector, Vector]:
    """x, y, depth (n,) of the commanded tip, at most `STEP_MM` apart, corners included."""
    corners = np.array([(w.x_mm, w.y_mm, w.depth_mm) for w in path])
    pieces = [corners[:1]]
    for a, b in itertools.pairwise(corners):
        count = max(1, math.ceil(float(np.linalg.norm(b - a)) / STEP_MM))
        pieces.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    points = np.concatenate(pieces)
    return points[:, 0], points[:, 1], points[:, 2]


def ink_left(ink_load: float, travel_mm: float) -> float:
    """Ink load after `travel_mm` of a drag."""
    return max(0.0, ink_load - INK_PER_MM * travel_mm)


def draw_drag(
    path: Sequence[Waypoint],
    stances: Stances,
    heading_rad: float,
    tuft: Tuft,
    ink_load: float,
    paper_rng: np.random.Generator,
) -> Footprint:
    """Lay the patch along the path, in a frame parallel to the paper's with its origin at the first waypoint."""
    start = path[0]
    local = tuple(Waypoint(w.x_mm - start.x_mm, w.y_mm - start.y_mm, w.depth_mm) for w in path)
    stamps: dict[tuple[float, float, bool], _Stamp] = {}
    laid: list[tuple[_Stamp, Moment]] = []
    for moment in follow(local, stances, heading_rad):
        if moment.depth_mm <= 0.0:
            continue
        load = round(ink_left(ink_load, moment.travel_mm) / LOAD_STEP) * LOAD_STEP
        key = (max(1, round(moment.depth_mm / DEPTH_STEP_MM)) * DEPTH_STEP_MM, min(load, 1.0), moment.pulled)
        if key not in stamps:
            stamps[key] = _stamp(stances.at(key[0], key[2]), tuft, key[1])
        laid.append((stamps[key], moment))
    corners = np.concatenate([_corners_mm(*item) for item in laid])
    shape_px, origin = frame_around(corners[:, 0], corners[:, 1], PX_PER_MM, MARGIN_MM)
    wet = np.zeros(shape_px, np.float32)
    load_map = np.zeros(shape_px, np.float32)
    for stamp, moment in laid:
        column, row = origin[0] + moment.x_mm * PX_PER_MM, origin[1] - moment.y_mm * PX_PER_MM
        _lay(wet, load_map, stamp, column, row, moment)
    density = soak(wet, load_map, PX_PER_MM, paper_rng, tuft.bundle.spec)
    return Footprint(density, PX_PER_MM, origin)


@dataclass(frozen=True, slots=True)
class _Stamp:
    """Ink offered by the patch of one moment, in the brush's frame, around the middle of the patch."""

    wet: Image
    origin_px: tuple[float, float]
    load: float


def _stamp(shape: SpineShape, tuft: Tuft, load: float) -> _Stamp:
    dots = tuft.touch(shape, load)
    dots = replace(dots, x_mm=dots.x_mm - middle_mm(shape))
    shape_px, origin = frame_around(dots.x_mm, dots.y_mm, PX_PER_MM, STAMP_MARGIN_MM)
    return _Stamp(scatter(dots, shape_px, origin, PX_PER_MM, load, tuft.bundle.spec), origin, load)


def _corners_mm(stamp: _Stamp, moment: Moment) -> Vector:
    """(4, 2) corners of a laid stamp at its full length."""
    h, w = stamp.wet.shape
    u = (np.array([0.0, w, 0.0, w]) - stamp.origin_px[0]) / PX_PER_MM
    v = (stamp.origin_px[1] - np.array([0.0, 0.0, h, h])) / PX_PER_MM
    cos, sin = math.cos(moment.heading_rad), math.sin(moment.heading_rad)
    return np.column_stack([moment.x_mm + cos * u - sin * v, moment.y_mm + sin * u + cos * v])


def _lay(wet: Image, load_map: Image, stamp: _Stamp, column: float, row: float, moment: Moment) -> None:
    """Shorten and turn a stamp as at the moment, put its middle there, and keep the wetter of each pixel."""
    h, w = stamp.wet.shape
    ox, oy = stamp.origin_px
    far = math.ceil(math.hypot(max(ox, w - ox), max(oy, h - oy))) + 1
    left, top = max(0, int(column) - far), max(0, int(row) - far)
    right, bottom = min(wet.shape[1], int(column) + far + 1), min(wet.shape[0], int(row) + far + 1)
    length, cos, sin = moment.length, math.cos(moment.heading_rad), math.sin(moment.heading_rad)
    # rows run against y; pixel centres lie on halves here and on integers in OpenCV
    linear = np.array([[length * cos, sin], [-length * sin, cos]])
    offset = np.array([column - left - 0.5, row - top - 0.5]) - linear @ np.array([ox - 0.5, oy - 0.5])
    size = (right - left, bottom - top)
    turned = np.asarray(cv2.warpAffine(stamp.wet, np.column_stack([linear, offset]), size), np.float32)
    patch = wet[top:bottom, left:right]
    passed = load_map[top:bottom, left:right]
    # paper that a fuller brush has wetted stays wet when a drier one passes
    np.maximum(passed, stamp.load, out=passed, where=turned > 0.0)
    np.maximum(patch, turned, out=patch)
