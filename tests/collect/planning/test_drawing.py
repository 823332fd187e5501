"""A stroke that is drawn on the loopback rig lies where its trajectory says."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.motion import Procedures, stroke_moves
from brushloop.collect.planning.limit_check import check_step
from brushloop.collect.planning.walk import sheet_of, walk
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.steps import Drawn, DrawStep
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import Rig, make_robot
from brushloop.collect.rig.paper import PaperPlane
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import Addresses, rig_toml
from brushloop.drivers.sim.world import World
from brushloop.sessions.events import Condition, Press

WRITE = Path(__file__).parents[3] / "examples" / "protocol-write.toml"
PLANE = PaperPlane(120.0)


@dataclass
class Desk:
    procedures: Procedures
    world: World
    config: RigConfig


@pytest.fixture
def config(tmp_path: Path) -> RigConfig:
    (tmp_path / "rig.toml").write_text(rig_toml(SimConfig(), Addresses("127.0.0.1", 1, 2, 3, 4, "x")))
    return load_rig(tmp_path / "rig.toml")


@pytest.fixture
async def desk(config: RigConfig) -> AsyncIterator[Desk]:
    world = World(SimConfig(rate=20.0))
    server = ArcsServer(world)
    await server.start("127.0.0.1", 0)
    here = config.robot.model_copy(update={"port": server.port, "rtde_port": None})
    arm = make_robot(config.model_copy(update={"robot": here}), HostClock(), lambda _: None)
    await arm.connect()
    await arm.enable()
    nothing = cast("Any", None)
    procedures = Procedures(Rig(config, HostClock(), arm, nothing, nothing, nothing))
    yield Desk(procedures, world, config)
    await arm.close()
    await server.stop()


def first_drawn(config: RigConfig) -> Drawn:
    return next(w.step.drawn for w in walk(config, load_protocol(WRITE)) if isinstance(w.step, DrawStep))


async def test_a_drawn_stroke_is_one_drag_through_its_points(desk: Desk) -> None:
    drawn = first_drawn(desk.config)
    patch = sheet_of(desk.config, load_protocol(WRITE)).patch(0)
    depth_mm = await desk.procedures.stroke(patch, drawn, 0)
    assert depth_mm == pytest.approx(drawn.strokes[0][0][2], abs=0.05)
    [drag] = desk.world.drags
    assert not desk.world.presses
    for x_mm, y_mm, depth_mm, *_ in drawn.strokes[0]:
        near = min(
            abs(w.x_mm - patch.x_mm - x_mm) + abs(w.y_mm - patch.y_mm - y_mm) + abs(w.depth_mm - depth_mm)
            for w in drag.path
        )
        assert near < 0.8
    assert drag.heading_deg % 360.0 == pytest.approx(180.0, abs=0.1)
    assert desk.world.tool().z_mm == pytest.approx(desk.config.motion.safe_z_mm, abs=0.05)


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


def test_all_of_a_figure_is_checked(config: RigConfig) -> None:
    drawn, patch = first_drawn(config), sheet_of(config, load_protocol(WRITE)).patch(0)
    step = DrawStep(0, Press(stroke_id="yong", condition=Condition(10.0, 0.0)), drawn)
    check_step(Path("rig.toml"), config, PLANE, step, [patch])
    drawn.strokes[1][-1] = (40.0, 12.0, 1.0, 20.0, 90.0)
    with pytest.raises(ConfigError, match="tilt"):
        check_step(Path("rig.toml"), config, PLANE, step, [patch])
