"""Another client of the controller sends one line at a random moment of a press: no press that was dragged counts, and
whoever reads the message knows where to look."""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from brushloop.collect.errors import StepVoid
from brushloop.collect.motion import Procedures
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.paper import Patch, Sheet, to_base
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ArmMoved, PathDisturbed
from brushloop.drivers.geometry import brush_pose, to_wire
from brushloop.drivers.sim.config import SimConfig
from brushloop.sessions.records import Condition
from tests.rigs import COARSE, Lab, coarse, wireless_lab
from tests.simulated_time import MemoryLoop

if TYPE_CHECKING:
    from brushloop.drivers.sim.rig import LoopbackRig
HOLD, LINE, RELEASE = (f"rob1.MotionControl.{name}" for name in ("stopMove", "moveLine", "startMove"))
REQUESTS_IN_HOLD = 10
"""Five lines, the checks around them and the release."""
MOVES_S = 3.2
"""Of the rig's time: a press, from its release to the end of its lift, without its dwell."""
OFF_MM = 0.5
DEPTH_MM = 17.0


@dataclass
class Intruder:
    """A client whose line reaches the controller at one moment of each press; it sees where the brush really went."""

    rig: LoopbackRig
    random: random.Random
    press_s: float
    anchor_mm: tuple[float, float] = (0.0, 0.0)
    """Axis of the press, in the base frame."""
    accepted: int = 0
    dragged_mm: float = 0.0
    """Largest distance from the axis at which the tip moved in the paper during this press."""
    _due: int | float | None = None
    """Requests until the line is sent in the hold, or seconds of the rig's time after the release."""
    _methods: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        world = self.rig.world
        travelled, paper_mm = world.motion._on_path, self.rig.config.table.paper_z_mm
        self._methods = dict(self.rig.arcs._methods)

        def noted(start: Pose, end: Pose) -> None:
            for pose in (start, end):
                if pose.z_mm < paper_mm - 0.1:
                    off_mm = math.dist((pose.x_mm, pose.y_mm), self.anchor_mm)
                    self.dragged_mm = max(self.dragged_mm, off_mm)
            travelled(start, end)

        world.motion._on_path = noted
        for name, method in self._methods.items():
            self.rig.arcs._methods[name] = lambda params, name=name, method=method: self._meet(name, method, params)

    def begin(self, anchor_mm: tuple[float, float]) -> None:
        """Lie in wait for the next press."""
        self.anchor_mm, self.accepted, self.dragged_mm = anchor_mm, 0, 0.0
        in_hold = self.random.random() < 0.5
        self._due = self.random.randrange(REQUESTS_IN_HOLD) if in_hold else self.random.uniform(0.0, self.press_s)

    def _meet(self, name: str, method: Any, params: dict[str, Any]) -> Any:
        if isinstance(self._due, int) and self.rig.world.motion.held:
            self._due -= 1
            if self._due < 0:
                self._send()
        result = method(params)
        if isinstance(self._due, float) and name == RELEASE and self.rig.world.motion.size:
            after_s, self._due = self._due / self.rig.world.clock.rate, None
            asyncio.get_running_loop().call_later(after_s, self._send)
        return result

    def _send(self) -> None:
        self._due = None
        x_mm, y_mm = (at + self.random.uniform(-60.0, 60.0) for at in self.anchor_mm)
        target = brush_pose(x_mm, y_mm, self.rig.config.table.paper_z_mm + self.random.uniform(-18.0, 40.0))
        line = {"pose": to_wire(target), "a": 1.0, "v": self.random.uniform(0.02, 0.25), "blend_radius": 0.0}
        self.accepted = int(self._methods[LINE](line | {"duration": 0.0}) == 0)


async def lifted(procedures: Procedures) -> None:
    """Lift and park, as a run does once the other client is gone: its last line may still be under way."""
    while True:
        with contextlib.suppress(ArmMoved):
            return await procedures.retreat()
        await asyncio.sleep(0.01)


async def pressed(lab: Lab, seed: int, presses: int) -> Counter[str]:
    """What became of so many presses with another client's line in each."""
    config, seen, source = load_rig(lab.folder / "rig.toml"), Counter[str](), random.Random(seed)
    sheet, intruder = Sheet(config.paper), Intruder(lab.rig, source, MOVES_S + config.motion.least_dwell_s)
    async with lab.rig.connected(config, lab.rig.time, lambda _: None) as rig:
        await rig.robot.enable()
        procedures = Procedures(rig)
        await lifted(procedures)
        for number in range(presses):
            patch: Patch = sheet.patch(number % sheet.capacity)
            intruder.begin(to_base(config.paper, *patch.anchor_mm))
            named, counted = False, False
            try:
                await procedures.press(patch, Condition(DEPTH_MM, 0.0), 0.2)
                counted = True
                await rig.robot.confirm()  # as a run does before its next step
            except (PathDisturbed, ArmMoved) as error:
                named = "nother client" in str(error)
            except StepVoid:
                pass
            seen["accepted"] += intruder.accepted
            dragged = intruder.dragged_mm > OFF_MM
            seen["dragged"] += dragged
            seen["counted"] += counted
            seen["dragged and counted"] += dragged and counted
            seen["not named"] += bool(intruder.accepted) and not named
            await lifted(procedures)
    return seen


def seen_in(folder: Path, config: SimConfig, seed: int, presses: int) -> Counter[str]:
    with (
        wireless_lab(folder, config) as lab,
        asyncio.Runner(loop_factory=lambda: MemoryLoop(lab.rig.time)) as runner,
    ):
        return runner.run(pressed(coarse(lab), seed, presses))


def test_a_press_with_a_line_of_another_client_is_named_and_never_counts_if_it_was_dragged(tmp_path: Path) -> None:
    seen = seen_in(tmp_path, COARSE, seed=1, presses=6)
    assert seen["accepted"] >= 5, seen
    assert (seen["dragged and counted"], seen["not named"]) == (0, 0), seen


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(2, 12))
def test_of_two_hundred_presses_with_another_clients_line_none_is_dragged_and_kept(
    tmp_path: Path, seed: int, record_property: Callable[[str, object], None]
) -> None:
    """Slow enough that a line does not pass between two questions of the driver."""
    seen = seen_in(tmp_path, replace(COARSE, rate=10.0), seed, presses=20)
    record_property("seen", dict(seen))
    assert seen["accepted"] >= 15, seen
    assert (seen["dragged and counted"], seen["not named"]) == (0, 0), seen
