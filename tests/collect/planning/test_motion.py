"""A press is believed where the brush was seen at its depth, and a drawn stroke lies where its trajectory says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from brushloop.collect.errors import StepVoid
from brushloop.collect.motion import Procedures, stroke_moves
from brushloop.collect.planning.walk import sheet_of, walk
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.steps import Drawn, DrawStep
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import PaperPlane, Sheet
from brushloop.drivers.devices import Identity, Pose, QueuedLine
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from brushloop.sessions.records import Condition

NOBODY = Identity("robot", "made up", "", True)


@pytest.fixture
def config(tmp_path: Path) -> RigConfig:
    (tmp_path / "rig.toml").write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 1, 2, 3, 4, "x")))
    return load_rig(tmp_path / "rig.toml")


class MadeUpRobot:
    """Goes nowhere; it says that it has seen its targets, `off_mm` higher, and of those only the slice `seen`."""

    def __init__(self, off_mm: float = 0.0, seen: slice = slice(None)) -> None:
        self.off_mm, self.seen = off_mm, seen
        self.moved: list[Pose] = []
        self.queued: list[QueuedLine] = []

    async def move(self, target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        self.moved.append(target)

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        self.queued += lines
        targets = [line.target for line in lines][self.seen]
        return [replace(pose, z_mm=pose.z_mm + self.off_mm) for pose in targets]


def made(config: RigConfig, robot: MadeUpRobot) -> Procedures:
    nothing = cast(Any, None)
    return Procedures(Rig(config, nothing, cast(Any, robot), nothing, NOBODY, nothing))


async def pressed(config: RigConfig, robot: MadeUpRobot, depth_mm: float = 13.0, dwell_s: float = 0.2) -> float:
    procedures = made(config, robot)
    return await procedures.press(Sheet(config.paper).patch(7), Condition(depth_mm, 10.0), dwell_s)


async def test_the_way_into_the_paper_and_out_again_is_handed_over_as_one(config: RigConfig):
    robot = MadeUpRobot()
    assert await pressed(config, robot) == pytest.approx(13.0)
    touch_mm = config.paper.touch_z_mm
    assert all(pose.z_mm > touch_mm + 7.0 for pose in robot.moved)
    assert robot.queued[-1].target.z_mm > touch_mm + 50.0
    assert min(line.target.z_mm for line in robot.queued) == pytest.approx(touch_mm - 13.0, abs=0.01)
    assert [line.least_s for line in robot.queued if line.least_s] == [0.2]


@pytest.mark.parametrize(("depth_mm", "dwell_s", "lasts_s"), [(13.0, 0.0, 0.1), (0.04, 2.0, 2.0)])
async def test_every_press_stays_long_enough_to_be_seen(
    config: RigConfig, depth_mm: float, dwell_s: float, lasts_s: float
):
    robot = MadeUpRobot()
    assert await pressed(config, robot, depth_mm, dwell_s) == pytest.approx(depth_mm)
    near, deep = (line for line in robot.queued if line.target.z_mm < config.paper.touch_z_mm - 1e-6)
    assert deep.least_s == lasts_s
    assert 0.0 < near.target.z_mm - deep.target.z_mm <= 0.051


@pytest.mark.parametrize("off_mm", [0.15, -0.15])
async def test_a_press_that_was_not_seen_at_its_depth_is_void(config: RigConfig, off_mm: float):
    with pytest.raises(StepVoid, match=f"the depth was {13.0 - off_mm:.3f} mm, 13 mm was commanded"):
        await pressed(config, MadeUpRobot(off_mm))
    assert await pressed(config, MadeUpRobot(0.5 * off_mm)) == pytest.approx(13.0 - 0.5 * off_mm)


@pytest.mark.parametrize("seen", [slice(0, 1), slice(4, None), slice(0)])
async def test_a_depth_that_nobody_saw_is_not_believed(config: RigConfig, seen: slice):
    with pytest.raises(StepVoid, match="13 mm was commanded"):
        await pressed(config, MadeUpRobot(seen=seen))


# Drawn strokes

WRITE = Path(__file__).parents[3] / "examples" / "protocol-write.toml"
PLANE = PaperPlane(120.0)


def first_drawn(config: RigConfig) -> Drawn:
    return next(w.step.drawn for w in walk(config, load_protocol(WRITE)) if isinstance(w.step, DrawStep))


def test_a_stroke_may_come_down_on_its_way(config: RigConfig) -> None:
    """Points above the paper: a flying start. The brush is as far above it as asked when the way begins."""
    patch = sheet_of(config, load_protocol(WRITE)).patch(0)
    points = [(10.0, 10.0, -4.0, 3.0, 0.0), (20.0, 10.0, 5.0, 3.0, 0.0), (30.0, 10.0, -4.0, 3.0, 0.0)]
    *down, path, _, _ = stroke_moves(config, PLANE, patch, points, 15.0)
    assert [move.target.z_mm for move in down] == pytest.approx([180.0, 132.0, 132.0, 124.0])
    assert [pose.z_mm for pose in path.poses] == pytest.approx([115.0, 124.0])


def test_the_wrist_turns_where_the_brush_is_upright_and_high(config: RigConfig) -> None:
    patch = sheet_of(config, load_protocol(WRITE)).patch(0)
    [high, clear, *_] = stroke_moves(config, PLANE, patch, first_drawn(config).strokes[1], 15.0)
    assert high.target.quaternion == pytest.approx(clear.target.quaternion)
