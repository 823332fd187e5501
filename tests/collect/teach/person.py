"""A person at the known loopback rig: answers as one would from what is printed, and a hand that guides the arm."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.collect.operator import Choice
from brushloop.collect.teach.guide import Brought, JogStep, JogView, LeftOff, Shown, StepState, Target
from brushloop.drivers.devices import Pose
from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.rig import LoopbackRig

CORNERS = ("lower left", "lower right", "upper right", "upper left")
PIN_MM = (330.0, 180.0, 160.0)


@dataclass
class Hand:
    """Brings the true tip to things of the loopback rig, with an error in each axis."""

    rig: LoopbackRig
    error_mm: float = 0.15
    seed: int = 1

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def bring(self, target: Target) -> None:
        place, heading_deg, tilt_deg = self._place(target)
        x, y, z = np.array(place) + self._rng.normal(0.0, self.error_mm, 3)
        self._put(leaning(x, y, z, heading_deg, tilt_deg, wrist_deg=self.rig.config.table.yaw_deg))

    def push(self, force_n: float = 2.0, seconds: float = 0.5) -> None:
        """A finger pushes the tip up for a while."""
        world, until_s = self.rig.world, time.monotonic() + seconds
        at_rest = world.wrench

        def pushed() -> Wrench:
            fx, fy, fz, *torque = at_rest()
            return (fx, fy, fz - (force_n if time.monotonic() < until_s else 0.0), *torque)

        world.wrench = pushed

    def _put(self, pose: Pose) -> None:
        motion = self.rig.world.motion
        motion._rest = pose
        motion._rest_since_s = self.rig.world.clock.now_s() - 1.0

    def _place(self, target: Target) -> tuple[tuple[float, float, float], float, float]:
        table = self.rig.config.table
        upright = table.yaw_deg, 0.0
        match target.kind:
            case "pin":
                return PIN_MM, 90.0 * target.index + 20.0 * (target.index // 4), 35.0
            case "board-corner":
                size = [n * table.board_square_mm for n in table.board_squares]
                return (self._at(_corner(target.corner, table.board_origin_mm, size)), *upright)
            case "sheet-corner":
                return (self._at(_corner(target.corner, (0.0, 0.0), list(table.sheet_mm))), *upright)
            case "well":
                x, y, z = self._at(table.well_mm)
                return ((x, y, z + table.ink_level_mm - 8.0), *upright)
            case "well-rim":
                angle = math.radians(180.0 + 120.0 * target.index)
                x, y = table.well_mm
                r = table.well_radius_mm
                bx, by, z = self._at((x + r * math.cos(angle), y + r * math.sin(angle)))
                return ((bx, by, z + table.well_depth_mm), *upright)
            case "park" | "clear-view":
                return (self.rig.config.home_mm, *upright)
            case other:
                raise AssertionError(f"nothing to bring the tip to: {other}")

    def _at(self, paper_mm: tuple[float, float]) -> tuple[float, float, float]:
        table = self.rig.config.table
        x, y, _ = Rotation.from_euler("z", table.yaw_deg, degrees=True).apply([*paper_mm, 0.0])
        return table.origin_mm[0] + float(x), table.origin_mm[1] + float(y), table.surface_z_mm(*paper_mm)


def leaning(x_mm: float, y_mm: float, z_mm: float, toward_deg: float, tilt_deg: float, wrist_deg: float) -> Pose:
    """The tip at a place, the brush leaning toward a side while the wrist stays as it is."""
    toward = math.radians(toward_deg)
    lean = Rotation.from_rotvec(math.radians(tilt_deg) * np.array([-math.sin(toward), math.cos(toward), 0.0]))
    upright = Rotation.from_quat(brush_pose(0.0, 0.0, 0.0, heading_deg=wrist_deg).quaternion)
    qx, qy, qz, qw = (float(v) for v in (lean * upright).as_quat())
    return Pose(x_mm, y_mm, z_mm, qx, qy, qz, qw)


def _corner(name: str, origin: tuple[float, float], size: list[float]) -> tuple[float, float]:
    x, y = origin
    return x + size[0] * ("right" in name), y + size[1] * ("upper" in name)


@dataclass
class Person:
    """Answers questions by their first words; `stop_at` leaves off at the first request that it accepts."""

    answers: dict[str, str]
    hand: Callable[[Target], Brought]
    lines: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    brought: list[Target] = field(default_factory=list)
    stop_at: Callable[[str], bool] = lambda _question: False

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        self.lines.append(" ".join(f"{step.name}:{step.state}" for step in steps))

    async def show(self, what: Shown) -> None:
        self.lines += [f"{what.tone}: {line}" for line in what.lines]

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
        answer = self._answer(question, default)
        assert answer in {choice.key for choice in choices}, question
        return answer

    async def number(self, question: str, unit: str, low: float, high: float, default: float | None) -> float:
        value = float(self._answer(question, "" if default is None else f"{default}"))
        assert low <= value <= high, question
        return value

    async def text(self, question: str, default: str) -> str:
        return self._answer(question, default)

    async def bring(self, target: Target, how: str) -> Brought:
        if self.stop_at(how):
            raise LeftOff
        self.brought.append(target)
        return self.hand(target)

    async def jog(self, view: JogView) -> JogStep | Brought:
        raise AssertionError("the arm was not armed")

    def _answer(self, question: str, default: str) -> str:
        if self.stop_at(question):
            raise LeftOff
        self.asked.append(question)
        return next((answer for start, answer in self.answers.items() if question.startswith(start)), default)

    @property
    def trouble(self) -> str:
        return " ".join(line for line in self.lines if line.startswith("trouble"))
