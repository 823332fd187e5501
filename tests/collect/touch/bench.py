"""A rig without wires: the loopback world moved, felt and photographed directly, so that a touch takes milliseconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.motion import Procedures, photograph_moves
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.drivers.devices import Frame, Pose, QueuedLine, Stamp
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import rig_toml
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import SimClock, World
from tests.rigs import SMALL_TABLE
from tests.simulated_time import SimulatedTime

SMALL_VIEW = View(width_px=480, height_px=360, px_per_mm=2.8, centre_mm=(55.0, 40.0))
WHOLE_VIEW = View(width_px=1024, height_px=768, px_per_mm=3.125)
"""Of a sheet of the usual size."""


@dataclass
class Bench:
    """Arm, camera and force sensor over one world, the rig that they are, and its procedures beside a person who keeps
    the well full. Time passes only when the arm moves. The operator taught 120 mm, whatever the paper's height is."""

    folder: Path
    """Where its `rig.toml` is written."""
    slope_deg: tuple[float, float] = (0.0, 0.0)
    """How a small sheet leans."""
    paper_z_mm: float = 120.0
    seed: int = 1
    whole: bool = False
    """Whether the sheet is of the usual size, at the height that was taught."""
    bent: Callable[[Pose], Pose] = lambda pose: pose
    """What the arm makes of a target: for arms that are mounted wrong."""
    sent: list[Pose] = field(default_factory=list[Pose])
    """Every target that the arm was sent."""

    def __post_init__(self) -> None:
        table = replace(SMALL_TABLE, slope_deg=self.slope_deg, paper_z_mm=self.paper_z_mm)
        self.sim = SimConfig(seed=self.seed, table=table, view=SMALL_VIEW)
        if self.whole:
            self.sim = SimConfig(seed=self.seed, view=WHOLE_VIEW)
        self.time = SimulatedTime()
        self.world = World(self.sim, SimClock(real_s=self.time.seconds))
        self.scene = Scene(self.world)
        self.rng = np.random.default_rng(self.seed)
        self.weight_n = self.world.wrench()[2]
        self.target = brush_pose(*self.sim.home_mm)
        text = re.sub(r"touch_z_mm = .*", "touch_z_mm = 120.0", rig_toml(self.sim))
        (self.folder / "rig.toml").write_text(text)
        config = load_rig(self.folder / "rig.toml")
        self.limits = limits_of(config)
        devices: Any = self
        self.rig = Rig(config, self.time, devices, devices, force=devices)
        self.effector = Procedures(self.rig)
        self.effector.dip = self.dip
        self.effector.photographer.photograph = self.see_sheet

    def truth_mm(self, x_mm: float, y_mm: float) -> float:
        """The height of the sheet."""
        return self.sim.table.surface_z_mm(x_mm, y_mm)

    @property
    def lifted(self) -> bool:
        """Whether the tip is at travel height or above."""
        return self.target.z_mm >= self.rig.config.motion.safe_z_mm

    # Robot
    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float) -> None:
        [target] = poses
        self.limits.check("robot", target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
        self.target = target
        self.sent.append(target)
        self.world.motion.add(self.bent(target), speed_mm_s, acc_mm_s2, self.world.clock.now_s())
        self.time.pass_s(1e3)
        self.world.motion.advance(self.world.clock.now_s())

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        for line in lines:
            await self.follow([line.target], speed_mm_s=line.speed_mm_s, acc_mm_s2=acc_mm_s2)
        return [line.target for line in lines]

    async def where(self) -> Pose:
        return self.target

    # Camera
    async def fresh(self, after: Stamp) -> Frame:
        return Frame(Stamp(self.time.now_ns()), after.host_ns, self.photograph())

    def photograph(self) -> NDArray[np.uint8]:
        return self.scene.render(tool=self.world.tool())

    # Force
    async def average(self, samples: int, push_axis: tuple[float, float, float], after_ns: int) -> tuple[float, float]:
        """Of the world's own force with the rig's noise, drawn at once."""
        push_n = self.weight_n - self.world.wrench()[2]
        drawn = self.rng.normal(push_n, self.sim.force_noise_n, samples)
        return float(drawn.mean()), float(drawn.std(ddof=1))

    # Procedures
    async def dip(self) -> None:
        self.world.well.add(5.0)
        await Procedures.dip(self.effector)

    async def see_sheet(self) -> Frame:
        """Without wires no picture is late: there is no delay to measure."""
        await self.effector.go(*photograph_moves(self.rig.config))
        return await self.fresh(Stamp(self.time.now_ns()))
