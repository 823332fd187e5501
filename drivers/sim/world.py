"""The simulated world: where the tool is, its contacts with paper and ink, the force on it, and its sheet of marks."""

import functools
import itertools
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.force.sri_m8123 import Wrench
from brushloop.drivers.geometry import (
    brush_pose,
    columns,
    from_wire,
    interpolate,
    inverse,
    lean,
    of_angles,
    of_vector,
    product,
    turned,
    unit,
)
from brushloop.drivers.ink.simulator import Well
from brushloop.drivers.sim.brush.brush import MAX_TILT_DEG, Brush, BrushSpec
from brushloop.drivers.sim.brush.drag import Waypoint, ink_left
from brushloop.drivers.sim.brush.footprint import PX_PER_MM, Flaw, Footprint, Image, natural_split
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.kinematics import Matrix, matrix_of
from brushloop.drivers.sim.motion import MotionQueue

SIDEWAYS_MM = 0.5
"""A contact that travels less far sideways is a press."""


def _sideways_mm(a: Pose, b: Pose) -> float:
    """Travel along the paper or across the brush's axis, whichever is shorter."""
    travel = np.subtract(b.position_mm, a.position_mm)
    axis = np.array(columns(unit(b.quaternion))[2])
    return min(math.hypot(travel[0], travel[1]), float(np.linalg.norm(travel - (travel @ axis) * axis)))


TILTS_DEG = (0.0, 7.5, 15.0, 30.0)
"""Tilts for which the push is solved; between them it is interpolated."""
GRAVITY_M_S2 = 9.81
ALONG_RAD = 1e-6


@functools.lru_cache(maxsize=8)
def push_on(spec: BrushSpec) -> Callable[[float, float], float]:
    """The paper's push on one brush: the normal force in N by depth in mm and tilt in deg, 0 in the air.

    It comes from the same spine as the ink, on the way down, and takes some tenths of a second to find. Friction along
    the paper, the pull of the menisci and the hysteresis on the way up are left out: only the normal force remains.
    """
    brush = Brush(spec)
    deepest_mm = brush.deepest_mm(TILTS_DEG[-1])
    rows = [brush.push_n(deepest_mm, tilt_deg) for tilt_deg in TILTS_DEG]
    steps_mm = np.linspace(0.0, deepest_mm, rows[0].size)

    def push_n(depth_mm: float, tilt_deg: float) -> float:
        at_tilts = [float(np.interp(depth_mm, steps_mm, row)) for row in rows]
        return float(np.interp(tilt_deg, TILTS_DEG, at_tilts)) if depth_mm > 0.0 else 0.0

    return push_n


def leaning_with(pose: Pose, normal: tuple[float, float, float]) -> Pose:
    """The pose in a frame whose z is the paper's normal, rotated from the base frame by the least angle."""
    if normal == (0.0, 0.0, 1.0):
        return pose
    nx, ny, nz = normal
    share = math.acos(nz) / math.hypot(nx, ny)  # of (ny, -nx, 0), the cross product of the normal and the level one
    level = of_vector((share * ny, share * -nx, 0.0))
    return Pose(*pose.position_mm, *product(level, unit(pose.quaternion)))


def bent_toward(pose: Pose, tilt_deg: float, heading_deg: float, set_lean_deg: float) -> float:
    """Direction into which the bundle bends: that of the lean, and for a brush almost upright that of its own set.

    The paper pushes at the tip, so the bundle bends to where its tip lies beside the ferrule's axis. The lean carries
    the tip toward `heading_deg`, and the set of hair that has been pressed carries it along the wrist's x as far as a
    lean of `set_lean_deg` would. Without the set, a brush that leans by a tenth of a degree would bend into any
    direction.
    """
    along, _, _ = columns(unit(pose.quaternion))
    wrist_deg = math.degrees(math.atan2(along[1], along[0]))
    off = math.radians(math.remainder(heading_deg - wrist_deg, 360.0))
    if abs(off) < ALONG_RAD:
        return heading_deg
    return wrist_deg + math.degrees(math.atan2(tilt_deg * math.sin(off), tilt_deg * math.cos(off) + set_lean_deg))


class SimClock:
    """A clock of simulated time, which passes `rate` times as fast as real time, as `real_s` tells it."""

    def __init__(self, rate: float = 1.0, real_s: Callable[[], float] = time.monotonic) -> None:
        self.rate = rate
        self.real_s = real_s
        self._start = real_s()

    def now_s(self) -> float:
        """Simulated seconds since this clock was created."""
        return (self.real_s() - self._start) * self.rate


INK_PER_PRESS = 0.12
"""Share of a full brush's ink that a press uses, or the landing of a drag."""


@dataclass(frozen=True, slots=True)
class Press:
    """One contact of brush and paper as it really happened: ground truth for tests."""

    x_mm: float
    y_mm: float
    depth_mm: float
    tilt_deg: float
    heading_deg: float
    ink_load: float
    flaw: Flaw | None = None
    """The flaw of the mark: scripted, or a spontaneous split."""


class Paper:
    """Ink per area on a sheet of (width, height) mm; row 0 is the far edge (largest y), as a camera sees it."""

    def __init__(self, size_x_mm: float, size_y_mm: float) -> None:
        self.size_x_mm = size_x_mm
        self.size_y_mm = size_y_mm
        shape = (round(size_y_mm * PX_PER_MM), round(size_x_mm * PX_PER_MM))
        self._density: Image = np.zeros(shape, np.float32)
        self._coming: deque[tuple[Callable[[], Footprint], float, float, float]] = deque()
        self._lock = threading.Lock()

    @property
    def density(self) -> Image:
        """Ink per area, (rows, columns), 0 to 1, including every mark laid so far."""
        with self._lock:
            while self._coming:
                make, x_mm, y_mm, heading_deg = self._coming[0]
                self._lay(make(), x_mm, y_mm, heading_deg)
                self._coming.popleft()
            return self._density

    @density.setter
    def density(self, density: Image) -> None:
        with self._lock:
            self._coming.clear()
            self._density = density

    def lay_later(self, make: Callable[[], Footprint], x_mm: float, y_mm: float, heading_deg: float) -> None:
        """When the sheet is next read, call `make` in the reader's thread and lay the footprint that it returns.

        A footprint takes a tenth of a second to compute, too long for the thread that moves the arm.
        """
        self._coming.append((make, x_mm, y_mm, heading_deg))

    def lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        """The same with a footprint at hand, whose scale is that of the sheet."""
        self.lay_later(lambda: footprint, x_mm, y_mm, heading_deg)

    def _lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        """Lay a footprint with its zero-touch point at (x, y) and its +x along the heading, on top of earlier ink."""
        cos, sin = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
        # Rows run against y, so a counter-clockwise heading is clockwise in row and column.
        linear = np.array([[cos, sin], [-sin, cos]])
        anchor = np.array([x_mm * PX_PER_MM, (self.size_y_mm - y_mm) * PX_PER_MM])
        # cv2 puts pixel centres on integers, our coordinates put them on halves.
        half = np.array([0.5, 0.5])
        offset = anchor - linear @ (np.array(footprint.origin_px) - half) - half
        rows, columns = self._density.shape
        laid = cv2.warpAffine(footprint.density, np.column_stack([linear, offset]), (columns, rows))
        height, width = footprint.density.shape
        corners = offset + np.array([(-1, -1), (width, -1), (width, height), (-1, height)]) @ linear.T
        left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
        right, bottom = np.maximum(np.ceil(corners.max(axis=0)).astype(int) + 2, 0)
        inked = np.s_[top:bottom, left:right]
        density = self._density.copy()  # other threads may hold the old array
        density[inked] = 1.0 - (1.0 - density[inked]) * (1.0 - np.clip(laid[inked], 0.0, 1.0))
        self._density = density


class World:
    """Tool, brush, ink and sheet under one clock.

    The ink depends on the tool's path, not on when its pose is queried: contact is followed along finished
    stretches of the path, and a contact leaves its mark when the brush lifts off.
    """

    def __init__(self, config: SimConfig, clock: SimClock | None = None) -> None:
        self.config = config
        self.clock = clock or SimClock(config.rate)
        self.brush = Brush(config.brush, config.misfit)
        self.paper = Paper(*config.table.sheet_mm)
        self.presses: list[Press] = []
        self.drags = 0
        """Number of contacts that travelled along the paper."""
        self.splits: dict[int, float] = {}
        """Scripted severity of a split by the index of the press; 0 rules out a spontaneous one."""
        self.ink_load = 0.0
        table = config.table
        self.well = Well(math.pi * table.well_radius_mm**2 / 1e3, table.ink_level_mm, table.well_depth_mm)
        self.version = 0
        """Number of visible changes to the sheet so far."""
        self._contact: list[Pose] = []
        """The path of the tip at and below the paper plane, as long as the brush touches; straight between poses."""
        self.hand_guided = False
        """While a person guides the arm, the brush is dry and held lightly: contacts leave nothing."""
        self.push_n = (0.0, 0.0, 0.0)
        """Force of a person's finger on the tip, in the base frame."""
        self.motion = MotionQueue(brush_pose(*config.home_mm), self._travelled, tool_of(config))

    def fresh_sheet(self) -> None:
        """Replace the sheet by a blank one, as an operator would."""
        self.paper = Paper(*self.config.table.sheet_mm)
        self.version += 1

    def tool(self) -> Pose:
        """Current pose of the tip in the base frame."""
        return self.motion.pose(self.clock.now_s())

    def target(self) -> Pose | None:
        """End of the piece of the path that is being travelled; None at rest."""
        return self.motion.target(self.clock.now_s())

    def wrench(self) -> Wrench:
        """Force in N and torque in Nm now, as the sensor reports them: its axes and sign are those of its mounting."""
        config, tip, normal = self.config, self.tool(), self._normal
        x_mm, y_mm, depth_mm = self.on_sheet(tip)
        paper_n = 0.0
        if not self.is_over_well(x_mm, y_mm):
            paper_n = push_on(config.brush)(depth_mm, lean(leaning_with(tip, normal))[0])
        push_n, weight_n = (paper_n * part for part in normal), (0.0, 0.0, config.hanging_kg * GRAVITY_M_S2)
        force_n = [a - b + c for a, b, c in zip(push_n, weight_n, self.push_n, strict=True)]
        about_x, about_y = (math.radians(v) for v in config.tool_lean_deg)
        brush = of_angles(about_x, about_y, -math.radians(config.sensor_turn_deg))  # in the sensor's axes
        lever_m = turned(brush, (0.0, 0.0, config.tool_mm / 1e3))
        felt_n = turned(product(brush, inverse(unit(tip.quaternion))), [config.sensor_sign * f for f in force_n])
        return (*felt_n, *np.cross(lever_m, felt_n).tolist())

    def _travelled(self, start: Pose, end: Pose) -> None:
        """Follow one finished straight stretch of the path: dips into the well, and a contact until the brush lifts."""
        if self.hand_guided:
            return
        # Along a straight line the tip's height is linear, so the lowest point is one of the ends.
        for pose in (start, end):
            if self._is_in_ink(pose):
                self.ink_load = self.well.dip(self.ink_load)
        high, low = self._above_mm(start), self._above_mm(end)
        if high < 0.0 or low < 0.0:
            if not self._contact:
                self._contact.append(start if high < 0.0 else interpolate(start, end, high / (high - low)))
            self._contact.append(end if low < 0.0 else interpolate(start, end, high / (high - low)))
        if low >= 0.0 and self._contact:
            contact, self._contact = self._contact, []
            # Withdrawing along the brush's own axis is not a drag, even if it is tilted.
            if sum(_sideways_mm(a, b) for a, b in itertools.pairwise(contact)) > SIDEWAYS_MM:
                self._leave_drag(contact)
            else:
                self._leave_mark(min(contact, key=self._above_mm))

    def _leave_mark(self, deepest: Pose) -> None:
        x_mm, y_mm, depth_mm = self.on_sheet(deepest)
        if not self.is_over_sheet(x_mm, y_mm):
            return
        tilt_deg, heading_deg = self._lean(deepest)
        index = len(self.presses)
        rng = np.random.default_rng([self.config.seed, index, 3])
        severity = self.splits.get(index, natural_split(self.ink_load, depth_mm, rng))
        flaw = Flaw.SPLIT if severity > 0.0 else None
        make = functools.partial(
            self.brush.press,
            min(depth_mm, self.brush.deepest_mm(tilt_deg)),  # at most until the ferrule stands on the paper
            min(tilt_deg, MAX_TILT_DEG),
            ink_load=self.ink_load,
            press_seed=self.config.seed * 100_003 + index,
            flaw=flaw,
            severity=severity,
        )
        self.paper.lay_later(make, x_mm, y_mm, heading_deg)
        self.presses.append(Press(x_mm, y_mm, depth_mm, tilt_deg, heading_deg, self.ink_load, flaw))
        self.ink_load = max(0.0, self.ink_load - INK_PER_PRESS)
        self.version += 1

    def _leave_drag(self, contact: Sequence[Pose]) -> None:
        path = tuple(Waypoint(*self.on_sheet(pose)) for pose in contact)
        if not any(self.is_over_sheet(w.x_mm, w.y_mm) for w in path):
            return
        tilt_deg, _ = self._lean(min(contact, key=self._above_mm))
        _, heading_deg = self._lean(contact[0])
        make = functools.partial(
            self.brush.drag,
            tuple(replace(w, depth_mm=min(w.depth_mm, self.brush.deepest_mm(tilt_deg))) for w in path),
            min(tilt_deg, MAX_TILT_DEG),
            heading_deg,
            ink_load=self.ink_load,
            # an offset keeps it apart from the seeds of presses
            press_seed=2**40 + self.config.seed * 100_003 + self.drags,
        )
        self.paper.lay_later(make, path[0].x_mm, path[0].y_mm, 0.0)
        self.drags += 1
        travel_mm = sum(math.dist((a.x_mm, a.y_mm), (b.x_mm, b.y_mm)) for a, b in itertools.pairwise(path))
        self.ink_load = max(0.0, ink_left(self.ink_load, travel_mm) - INK_PER_PRESS)
        self.version += 1

    def on_sheet(self, pose: Pose) -> tuple[float, float, float]:
        """x and y in the paper frame of the point of the sheet nearest to the tip, and the tip's depth below it."""
        table = self.config.table
        x_mm, y_mm = table.to_paper(pose.x_mm, pose.y_mm)
        nx, ny, nz = table.normal
        depth_mm = (table.surface_z_mm(x_mm, y_mm) - pose.z_mm) * nz
        return x_mm + depth_mm * nx, y_mm + depth_mm * ny, depth_mm

    def _above_mm(self, pose: Pose) -> float:
        return -self.on_sheet(pose)[2]

    @property
    def _normal(self) -> tuple[float, float, float]:
        """Unit vector out of the sheet, in the base frame."""
        nx, ny, nz = self.config.table.normal
        yaw = math.radians(self.config.table.yaw_deg)
        return math.cos(yaw) * nx - math.sin(yaw) * ny, math.sin(yaw) * nx + math.cos(yaw) * ny, nz

    def is_over_well(self, x_mm: float, y_mm: float) -> bool:
        """Whether a point of the paper frame lies within the ink well."""
        return math.dist((x_mm, y_mm), self.config.table.well_mm) <= self.config.table.well_radius_mm

    def _is_in_ink(self, tip: Pose) -> bool:
        surface_z_mm = self.config.table.surface_z_mm(*self.config.table.well_mm) + self.well.level_mm
        return self.is_over_well(*self.config.table.to_paper(tip.x_mm, tip.y_mm)) and tip.z_mm < surface_z_mm

    def is_over_sheet(self, x_mm: float, y_mm: float) -> bool:
        """Whether a point of the paper frame lies on the sheet."""
        size_x_mm, size_y_mm = self.config.table.sheet_mm
        return 0.0 <= x_mm <= size_x_mm and 0.0 <= y_mm <= size_y_mm

    def _lean(self, pose: Pose) -> tuple[float, float]:
        """(tilt_deg, heading_deg) in the paper frame; tilt from the sheet's normal."""
        on_paper = leaning_with(pose, self._normal)
        tilt_deg, base_heading_deg = lean(on_paper)
        bent_deg = bent_toward(on_paper, tilt_deg, base_heading_deg, self.brush.set_lean_deg)
        return tilt_deg, bent_deg - self.config.table.yaw_deg


def tool_of(config: SimConfig) -> Matrix:
    """The true brush in the flange's frame, in m: z along the brush."""
    about_x, about_y = (math.radians(v) for v in config.tool_lean_deg)
    return matrix_of(from_wire([*(v / 1e3 for v in (*config.tool_sideways_mm, config.tool_mm)), about_x, about_y, 0.0]))
