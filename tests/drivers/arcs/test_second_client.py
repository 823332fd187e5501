"""Another client's line in a press: before the release it is refused, afterwards it is stopped, and always named."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import PathDisturbed
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.rig import HOST

X_MM, Y_MM, PAPER_Z_MM = 250.0, -230.0, 220.0
TOP, DEEP = brush_pose(X_MM, Y_MM, 300.0), brush_pose(X_MM, Y_MM, 200.0)
PRESS = [
    QueuedLine(brush_pose(X_MM, Y_MM, 200.05), 40.0),
    QueuedLine(DEEP, 40.0, 4.0),
    QueuedLine(TOP, 40.0),
]
ACC = 800.0
ASIDE = brush_pose(X_MM + 40.0, Y_MM + 10.0, 205.0)
"""15 mm under the paper, and 41 mm beside the press."""
LINE, SIZE, START = (f"rob1.MotionControl.{name}" for name in ("moveLine", "getQueueSize", "startMove"))
OFF_MM = 0.5


class Strays:
    """The largest distance from the axis of the press at which the tip moved in the paper."""

    def __init__(self, cabinet: ArcsServer) -> None:
        self.off_mm = 0.0
        motion = cabinet.cabinet.world.motion
        travelled = motion._on_path

        def noted(start: Pose, end: Pose) -> None:
            for pose in (start, end):
                if pose.z_mm < PAPER_Z_MM - 0.1:
                    self.off_mm = max(self.off_mm, math.hypot(pose.x_mm - X_MM, pose.y_mm - Y_MM))
            travelled(start, end)

        motion._on_path = noted


def before(cabinet: ArcsServer, method: str, number: int, act: Callable[[], object]) -> None:
    """Call `act` before the controller carries out the request with this number, counted from 1."""
    carry_out, count = cabinet._methods[method], 0

    def noted(params: dict[str, Any]) -> Any:
        nonlocal count
        count += 1
        if count == number:
            act()
        return carry_out(params)

    cabinet._methods[method] = noted


def sends(cabinet: ArcsServer, target: Pose) -> None:
    """Another client's line reaches the controller now."""
    world = cabinet.cabinet.world
    assert world.motion.add(target, 200.0, 800.0, world.clock.now_s())


@pytest.mark.parametrize(
    ("method", "number"),
    [(LINE, 1), (LINE, 2), (LINE, 3), (SIZE, 1)],
    ids=["before our first line", "between our lines", "before the lift", "after all our lines"],
)
async def test_a_line_that_comes_while_the_path_is_held_is_never_carried_out(
    arm: AuboArcs, cabinet: ArcsServer, method: str, number: int
) -> None:
    before(cabinet, method, number, lambda: sends(cabinet, ASIDE))
    here = cabinet.cabinet.world.tool()
    with pytest.raises(PathDisturbed, match=r"holds 4 lines, 3 were sent.*nother client"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert cabinet.cabinet.world.tool() == here
    assert cabinet.cabinet.world.motion.size == 0
    await arm.move(TOP, speed_mm_s=100.0, acc_mm_s2=ACC)


async def test_a_line_that_comes_between_the_last_check_and_the_release_is_stopped(
    arm: AuboArcs, cabinet: ArcsServer
) -> None:
    strays = Strays(cabinet)
    before(cabinet, START, 1, lambda: sends(cabinet, ASIDE))
    with pytest.raises(PathDisturbed, match="nother client"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
    assert strays.off_mm < OFF_MM
    assert cabinet.cabinet.world.motion.size == 0


async def client_of(cabinet: ArcsServer) -> Controller:
    client = Controller(RpcConnection(HOST, cabinet.port))
    client.robot = "rob1"
    await client.connection.open()
    return client


@pytest.mark.parametrize("at_mm", [250.0, 200.01])
async def test_a_line_that_comes_during_the_press_is_not_begun(
    arm: AuboArcs, cabinet: ArcsServer, at_mm: float
) -> None:
    strays, client = Strays(cabinet), await client_of(cabinet)
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    while cabinet.cabinet.world.tool().z_mm > at_mm:
        await asyncio.sleep(0.002)
    await client.move_line(ASIDE, 200.0, ACC)
    with pytest.raises(PathDisturbed, match=r"holds \d lines, at most \d of ours are left.*nother client"):
        await press
    assert strays.off_mm < OFF_MM
    assert cabinet.cabinet.world.motion.size == 0
    await client.connection.close()


async def test_a_client_that_stops_the_press_and_sends_its_own_line_is_seen_by_the_way_that_the_tip_took(
    arm: AuboArcs, cabinet: ArcsServer
) -> None:
    client = await client_of(cabinet)
    press = asyncio.create_task(arm.sequence(PRESS, acc_mm_s2=ACC))
    while cabinet.cabinet.world.tool().z_mm > 200.01:
        await asyncio.sleep(0.002)
    await client.halt(2.0)
    await client.move_line(ASIDE, 200.0, ACC)
    with pytest.raises(PathDisturbed, match=r"from its path.*nother client"):
        await press
    assert cabinet.cabinet.world.motion.size == 0
    await client.connection.close()


async def test_one_pose_beside_the_path_is_enough_even_if_the_arm_arrives(arm: AuboArcs) -> None:
    """Between two questions of the driver the tip may have been elsewhere; telemetry saw it."""
    telemetry = arm._telemetry
    reaching = telemetry.reaching

    async def reached(*target: Any) -> None:
        assert telemetry._seen is not None
        telemetry._seen.append(brush_pose(X_MM + 0.8, Y_MM, 201.0))
        await reaching(*target)

    telemetry.reaching = reached  # type: ignore[method-assign]
    with pytest.raises(PathDisturbed, match=r"0\.80 mm"):
        await arm.sequence(PRESS, acc_mm_s2=ACC)
