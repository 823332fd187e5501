"""A press is believed where the brush was seen at its depth, and nowhere else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from brushloop.collect.errors import StepVoid
from brushloop.collect.motion import Procedures, press_moves
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.collect.rig.paper import Sheet
from brushloop.drivers.devices import Identity, Pose, QueuedLine
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from brushloop.sessions.records import Condition

NOBODY = Identity("robot", "made up", "", True)


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


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 1, 1, 1, 1, None)), encoding="utf-8")
    return path


def made(rig_file: Path, robot: MadeUpRobot) -> Procedures:
    nothing, config = cast(Any, None), load_rig(rig_file)
    return Procedures(Rig(config, nothing, cast(Any, robot), nothing, NOBODY, nothing))


async def pressed(rig_file: Path, robot: MadeUpRobot, depth_mm: float = 13.0, dwell_s: float = 0.2) -> float:
    procedures = made(rig_file, robot)
    return await procedures.press(Sheet(load_rig(rig_file).paper).patch(7), Condition(depth_mm, 10.0), dwell_s)


async def test_the_way_into_the_paper_and_out_again_is_handed_over_as_one(rig_file: Path):
    robot = MadeUpRobot()
    assert await pressed(rig_file, robot) == pytest.approx(13.0)
    touch_mm = load_rig(rig_file).paper.touch_z_mm
    assert all(pose.z_mm > touch_mm + 7.0 for pose in robot.moved)
    assert robot.queued[-1].target.z_mm > touch_mm + 50.0
    assert min(line.target.z_mm for line in robot.queued) == pytest.approx(touch_mm - 13.0, abs=0.01)
    assert [line.least_s for line in robot.queued if line.least_s] == [0.2]


@pytest.mark.parametrize(("depth_mm", "dwell_s", "lasts_s"), [(13.0, 0.0, 0.1), (0.04, 2.0, 2.0)])
async def test_every_press_stays_long_enough_to_be_seen(
    rig_file: Path, depth_mm: float, dwell_s: float, lasts_s: float
):
    robot = MadeUpRobot()
    assert await pressed(rig_file, robot, depth_mm, dwell_s) == pytest.approx(depth_mm)
    near, deep = (line for line in robot.queued if line.target.z_mm < load_rig(rig_file).paper.touch_z_mm - 1e-6)
    assert deep.least_s == lasts_s
    assert 0.0 < near.target.z_mm - deep.target.z_mm <= 0.051


@pytest.mark.parametrize("off_mm", [0.15, -0.15])
async def test_a_press_that_was_not_seen_at_its_depth_is_void(rig_file: Path, off_mm: float):
    with pytest.raises(StepVoid, match=f"the depth was {13.0 - off_mm:.3f} mm, 13 mm was commanded"):
        await pressed(rig_file, MadeUpRobot(off_mm))
    assert await pressed(rig_file, MadeUpRobot(0.5 * off_mm)) == pytest.approx(13.0 - 0.5 * off_mm)


@pytest.mark.parametrize("seen", [slice(0, 1), slice(4, None), slice(0)])
async def test_a_depth_that_nobody_saw_is_not_believed(rig_file: Path, seen: slice):
    with pytest.raises(StepVoid, match="13 mm was commanded"):
        await pressed(rig_file, MadeUpRobot(seen=seen))


def test_every_move_of_a_press_lies_within_the_limits_and_ends_high(rig_file: Path):
    config = load_rig(rig_file)
    before, pressing = press_moves(
        config, made(rig_file, MadeUpRobot()).plane, Sheet(config.paper).patch(0), Condition(20.0, 15.0)
    )
    for move in before + pressing:
        limits_of(config).check("robot", move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=config.motion.acc_mm_s2)
    assert pressing[-1].target.z_mm == config.motion.safe_z_mm
