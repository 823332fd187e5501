"""A rig without wires: the loopback world moved, felt and photographed directly, so that a touch takes milliseconds."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from brushloop.collect.motion import Procedures, photograph_moves
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.collect.touch.force import ForceTap
from brushloop.drivers.devices import Frame, Identity, Pose, QueuedLine, Stamp
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import rig_toml
from brushloop.drivers.sim.scene import Scene
from brushloop.drivers.sim.world import World
from tests.rigs import SMALL_TABLE

SMALL_VIEW = View(width_px=480, height_px=360, px_per_mm=2.8, centre_mm=(55.0, 40.0))
WHOLE_VIEW = View(width_px=1024, height_px=768, px_per_mm=3.125)
"""Of a sheet of the usual size."""


class OwnClock:
    """Time that passes only when the arm moves."""

    rate = 1.0

    def __init__(self) -> None:
        self.seconds = 0.0

    def now_s(self) -> float:
        return self.seconds

    def now_ns(self) -> int:
        return round(self.seconds * 1e9)


@dataclass
class Bench:
    """Arm, camera, force sensor and clock over one world, and the rig that they are."""

    sim: SimConfig
    folder: Path
    bent: Callable[[Pose], Pose] = lambda pose: pose
    """What the arm makes of a target: for arms that are mounted wrong."""
    sent: list[Pose] = field(default_factory=list[Pose])
    """Every target that the arm was sent."""

    def __post_init__(self) -> None:
        self.clock = OwnClock()
        self.world = World(self.sim)
        self.world.clock = self.clock  # pyright: ignore[reportAttributeAccessIssue]
        self.scene = Scene(self.world)
        self.rng = np.random.default_rng(self.sim.seed)
        self.target = brush_pose(*self.sim.home_mm)
        text = re.sub(r"touch_z_mm = .*", "touch_z_mm = 120.0", rig_toml(self.sim))
        (self.folder / "rig.toml").write_text(text)
        config = load_rig(self.folder / "rig.toml")
        self.limits = limits_of(config)
        devices: Any = self
        identity = Identity("world without wires", "", True)
        self.rig = Rig(config, devices, devices, devices, identity, identity, force=devices)
        self.effector = BenchHands(self)
        self.tap = BenchTap(self)

    def truth_mm(self, x_mm: float, y_mm: float) -> float:
        """The height of the sheet."""
        return self.sim.table.surface_z_mm(x_mm, y_mm)

    @property
    def lifted(self) -> bool:
        """Whether the tip is at travel height or above."""
        return self.target.z_mm >= self.rig.config.motion.safe_z_mm

    # Clock
    def now_ns(self) -> int:
        return self.clock.now_ns()

    # Robot
    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        self.limits.check("robot", target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)
        self.target = target
        self.sent.append(target)
        self.world.motion.add(self.bent(target), speed_mm_s, acc_mm_s2, self.clock.seconds)
        self.clock.seconds += 1e3
        self.world.motion.advance(self.clock.seconds)

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        for line in lines:
            await self.move(line.target, speed_mm_s=line.speed_mm_s, acc_mm_s2=acc_mm_s2)
        return [line.target for line in lines]

    async def where(self) -> Pose:
        return self.target

    # Camera
    async def fresh(self, after: Stamp) -> Frame:
        return Frame(Stamp(self.clock.now_ns()), after.host_ns, self.photograph())

    def photograph(self) -> NDArray[np.uint8]:
        return self.scene.render(tool=self.world.tool())


class BenchTap(ForceTap):
    """Averages of the world's own force with the rig's noise, drawn at once."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self._bench = bench
        self._weight_n = bench.world.wrench()[2]

    async def average(self, samples: int, push_axis: tuple[float, float, float], after_ns: int) -> tuple[float, float]:
        push_n = self._weight_n - self._bench.world.wrench()[2]
        drawn = self._bench.rng.normal(push_n, self._bench.sim.force_noise_n, samples)
        return float(drawn.mean()), float(drawn.std(ddof=1))


class BenchHands(Procedures):
    """A rig's procedures beside a person who keeps the well full."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(bench.rig)
        self._well = bench.world.well
        self.photographer.photograph = self._photograph

    async def dip(self) -> None:
        self._well.add(5.0)
        await super().dip()

    async def _photograph(self) -> Frame:
        """Without wires no picture is late: there is no delay to measure."""
        await self.go(*photograph_moves(self.rig.config))
        return await self.rig.camera.fresh(Stamp(self.rig.clock.now_ns()))


MakeBench = Callable[..., Bench]


@pytest.fixture
def make_bench(tmp_path: Path) -> MakeBench:
    """A small sheet that leans so, at that height; the operator taught 120 mm whatever it is. Or a `whole` one."""

    def make(
        slope_deg: tuple[float, float] = (0.0, 0.0),
        *,
        paper_z_mm: float = 120.0,
        seed: int = 1,
        whole: bool = False,
    ) -> Bench:
        if whole:
            return Bench(SimConfig(seed=seed, view=WHOLE_VIEW), tmp_path)
        table = replace(SMALL_TABLE, slope_deg=slope_deg, paper_z_mm=paper_z_mm)
        return Bench(SimConfig(seed=seed, table=table, view=SMALL_VIEW), tmp_path)

    return make
