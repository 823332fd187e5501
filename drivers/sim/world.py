"""The simulated world: where the tool is, whether it touches paper or ink, and the marks it leaves."""

from __future__ import annotations

import functools
import itertools
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.geometry import brush_pose, from_wire, lean
from brushloop.drivers.sim.arm.kinematics import Matrix, matrix_of
from brushloop.drivers.sim.arm.motion import MotionQueue
from brushloop.drivers.sim.brush.brush import MAX_TILT_DEG, Brush
from brushloop.drivers.sim.brush.contact import Contact, ContactWatch, Reaction, bent_toward, leaning_with
from brushloop.drivers.sim.brush.drag import Waypoint, ink_left
from brushloop.drivers.sim.brush.footprint import Flaw, flaw_of_load, natural_split
from brushloop.drivers.sim.brush.paper import Paper
from brushloop.drivers.sim.config import SimConfig


class SimClock:
    """A clock of simulated time, which passes `rate` times as fast as real time."""

    def __init__(self, rate: float = 1.0) -> None:
        if not 0.0 < rate <= 1000.0:
            raise ValueError(f"rate = {rate} is outside (0, 1000]")
        self.rate = rate
        self._start = time.monotonic()

    def now_s(self) -> float:
        """Simulated seconds since this clock was created."""
        return (time.monotonic() - self._start) * self.rate


BRUSH_ML = 0.5
"""Volume of ink that a dry brush absorbs."""


class Well:
    """The ink well, a straight pot whose bottom is at height 0: dips lower its level, doses raise it."""

    def __init__(self, ml: float, capacity_ml: float, ml_per_mm: float = 1.0) -> None:
        self.ml = ml
        self.capacity_ml = capacity_ml
        self._ml_per_mm = ml_per_mm

    @classmethod
    def round(cls, radius_mm: float, level_mm: float, depth_mm: float) -> Well:
        """A round pot that is `depth_mm` deep, filled to `level_mm`."""
        ml_per_mm = math.pi * radius_mm**2 / 1e3
        return cls(level_mm * ml_per_mm, depth_mm * ml_per_mm, ml_per_mm)

    @property
    def level_mm(self) -> float:
        """Height of the ink above the bottom."""
        return self.ml / self._ml_per_mm

    @property
    def share(self) -> float:
        """Fill level, 0 to 1."""
        return min(1.0, self.ml / self.capacity_ml)

    def add(self, volume_ml: float) -> None:
        """Add a dose; any excess is lost."""
        self.ml = min(self.capacity_ml, self.ml + volume_ml)

    def dip(self, ink_load: float) -> float:
        """Fill a brush that holds `ink_load` (0 to 1); return its new load."""
        taken_ml = min(self.ml, (1.0 - ink_load) * BRUSH_ML)
        self.ml -= taken_ml
        return ink_load + taken_ml / BRUSH_ML


INK_PER_PRESS = 0.12
"""Share of a full brush's ink that a press uses, or the landing of a drag."""


@dataclass(frozen=True, slots=True)
class Press:
    """One contact of brush and paper as it really happened: ground truth for tests."""

    index: int
    x_mm: float
    y_mm: float
    depth_mm: float
    tilt_deg: float
    heading_deg: float
    ink_load: float
    flaw: Flaw | None = None
    """The flaw of the mark: scripted, a spontaneous split, or caused by the ink load."""
    severity: float = 0.0


@dataclass(frozen=True, slots=True)
class Drag:
    """One contact that travelled along the paper, as it really happened."""

    index: int
    path: tuple[Waypoint, ...]
    """The commanded tip in the paper frame, from touching to lifting off."""
    tilt_deg: float
    """Tilt at the deepest point."""
    heading_deg: float
    """Direction in which the ferrule leaned, or would have leaned, when the tip landed."""
    ink_load: float
    """Ink load at landing."""


class World:
    """Tool, brush, ink and sheet under one clock.

    The ink depends on the tool's path, not on when its pose is queried: contact is followed along finished
    stretches of the path, and a contact leaves its mark when the brush lifts off.
    """

    def __init__(self, config: SimConfig) -> None:
        self.config = config
        self.clock = SimClock(config.rate)
        self.brush = Brush(config.brush)
        self.paper = Paper(*config.table.sheet_mm)
        self.presses: list[Press] = []
        self.drags: list[Drag] = []
        self.flaws: dict[int, tuple[Flaw, float]] = {}
        """Scripted flaw and severity by the index of the press; severity 0 rules out a spontaneous split."""
        self.ink_load = 0.0
        table = config.table
        self.well = Well.round(table.well_radius_mm, table.ink_level_mm, table.well_depth_mm)
        self.reaction = Reaction(self.brush, sensor_to_tip_mm=config.sensor_to_tip_mm, hanging_kg=config.hanging_kg)
        self.version = 0
        """Number of visible changes to the sheet so far."""
        self._watch = ContactWatch(self._above_mm)
        self.hand_guided = False
        """While a person guides the arm, the brush is dry and held lightly: contacts leave nothing."""
        self.push_n = (0.0, 0.0, 0.0)
        """Force of a person's finger on the tip, in the base frame."""
        self.motion = MotionQueue(brush_pose(*config.home_mm), self._travelled, tool_of(config))
        self._felt: tuple[object, Wrench] | None = None
        """The state that the last wrench was computed from, and the wrench: neither changes while the arm rests."""

    def fresh_sheet(self) -> None:
        """Replace the sheet by a blank one, as an operator would."""
        self.paper = Paper(*self.config.table.sheet_mm)
        self.version += 1

    def tool(self) -> Pose:
        """Current pose of the tip in the base frame."""
        return self.motion.pose(self.clock.now_s())

    def wrench(self) -> Wrench:
        """Current wrench on the force sensor, in the tool's frame."""
        tip, table, push_n = self.tool(), self.config.table, self.push_n
        follows_from = tip, table, push_n
        if self._felt is None or self._felt[0] != follows_from:
            x_mm, y_mm, depth_mm = self._on_sheet(tip)
            free = self._in_well(x_mm, y_mm)
            self._felt = follows_from, self.reaction.wrench(tip, 0.0 if free else depth_mm, self._normal, push_n)
        return self._felt[1]

    def to_paper(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Convert x and y from the base frame to the paper frame."""
        return self.config.table.to_paper(x_mm, y_mm)

    def _travelled(self, start: Pose, end: Pose) -> None:
        if self.hand_guided:
            return
        # Along a straight line the tip's height is linear, so the lowest point is one of the ends.
        for pose in (start, end):
            self._dip(pose)
        contact = self._watch.travelled(start, end)
        if contact is None:
            return
        if contact.dragged:
            self._leave_drag(contact)
        else:
            self._leave_mark(contact.deepest)

    def _dip(self, pose: Pose) -> None:
        table = self.config.table
        x_mm, y_mm = self.to_paper(pose.x_mm, pose.y_mm)
        bottom_mm = table.surface_z_mm(*table.well_mm)
        if self._in_well(x_mm, y_mm) and pose.z_mm < bottom_mm + self.well.level_mm:
            self.ink_load = self.well.dip(self.ink_load)

    def _leave_mark(self, deepest: Pose) -> None:
        x_mm, y_mm, depth_mm = self._on_sheet(deepest)
        if not self._is_on_sheet(x_mm, y_mm):
            return
        tilt_deg, heading_deg = self._lean(deepest)
        index = len(self.presses)
        flaw, severity = self._flaw(index, depth_mm)
        deepest_mm = self.brush.deepest_mm(tilt_deg)
        make = functools.partial(
            self.brush.press,
            min(depth_mm, deepest_mm),  # at most until the ferrule stands on the paper
            min(tilt_deg, MAX_TILT_DEG),
            ink_load=self.ink_load,
            press_seed=self.config.seed * 100_003 + index,
            flaw=flaw,
            severity=severity,
        )
        self.paper.lay_later(make, x_mm, y_mm, heading_deg)
        want = flaw_of_load(self.ink_load)
        if want is Flaw.BLANK or (flaw is None and want is not None):
            # no ink on the hairs, or too little for the mark
            flaw, severity = want, 1.0 - self.ink_load
        self.presses.append(Press(index, x_mm, y_mm, depth_mm, tilt_deg, heading_deg, self.ink_load, flaw, severity))
        self.ink_load = max(0.0, self.ink_load - INK_PER_PRESS)
        self.version += 1

    def _leave_drag(self, contact: Contact) -> None:
        path = tuple(Waypoint(*self._on_sheet(pose)) for pose in contact.poses)
        if not any(self._is_on_sheet(w.x_mm, w.y_mm) for w in path):
            return
        tilt_deg, _ = self._lean(contact.deepest)
        _, heading_deg = self._lean(contact.poses[0])
        index = len(self.drags)
        make = functools.partial(
            self.brush.drag,
            tuple(replace(w, depth_mm=min(w.depth_mm, self.brush.deepest_mm(tilt_deg))) for w in path),
            min(tilt_deg, MAX_TILT_DEG),
            heading_deg,
            ink_load=self.ink_load,
            # an offset keeps it apart from the seeds of presses
            press_seed=2**40 + self.config.seed * 100_003 + index,
        )
        self.paper.lay_later(make, path[0].x_mm, path[0].y_mm, 0.0)
        self.drags.append(Drag(index, path, tilt_deg, heading_deg, self.ink_load))
        travel_mm = sum(math.dist((a.x_mm, a.y_mm), (b.x_mm, b.y_mm)) for a, b in itertools.pairwise(path))
        self.ink_load = max(0.0, ink_left(self.ink_load, travel_mm) - INK_PER_PRESS)
        self.version += 1

    def _flaw(self, index: int, depth_mm: float) -> tuple[Flaw | None, float]:
        """The flaw of this press: the scripted one, or a spontaneous split."""
        if index in self.flaws:
            flaw, severity = self.flaws[index]
        else:
            rng = np.random.default_rng([self.config.seed, index, 3])
            flaw, severity = Flaw.SPLIT, natural_split(self.ink_load, depth_mm, rng)
        return (flaw, severity) if severity > 0.0 else (None, 0.0)

    def _on_sheet(self, pose: Pose) -> tuple[float, float, float]:
        """x and y in the paper frame of the point of the sheet nearest to the tip, and the tip's depth below it."""
        x_mm, y_mm = self.to_paper(pose.x_mm, pose.y_mm)
        depth_mm = -self._above_mm(pose)
        nx, ny, _ = self.config.table.normal
        return x_mm + depth_mm * nx, y_mm + depth_mm * ny, depth_mm

    def _above_mm(self, pose: Pose) -> float:
        return self.config.table.above_mm(*self.to_paper(pose.x_mm, pose.y_mm), pose.z_mm)

    @property
    def _normal(self) -> tuple[float, float, float]:
        """Unit vector out of the sheet, in the base frame."""
        nx, ny, nz = self.config.table.normal
        yaw = math.radians(self.config.table.yaw_deg)
        return math.cos(yaw) * nx - math.sin(yaw) * ny, math.sin(yaw) * nx + math.cos(yaw) * ny, nz

    def _in_well(self, x_mm: float, y_mm: float) -> bool:
        return math.dist((x_mm, y_mm), self.config.table.well_mm) <= self.config.table.well_radius_mm

    def _is_on_sheet(self, x_mm: float, y_mm: float) -> bool:
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
