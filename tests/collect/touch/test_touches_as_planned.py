"""A touch that is measured stays where the plan has checked it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.planning.limit_check import check_step
from brushloop.collect.planning.walk import moves_of
from brushloop.collect.protocols.steps import SelfCheckStep, ZeroTouchStep
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.paper import PaperPlane, Sheet
from brushloop.collect.touch.measure import Jogged, measure_plane
from brushloop.collect.touch.selfcheck import partners, self_check, triangle_on
from brushloop.drivers.devices import Pose
from tests.collect.sent import lowest_mm, not_checked, not_sent

if TYPE_CHECKING:
    from conftest import Bench, MakeBench

TOUCH, CHECK = ZeroTouchStep(0), SelfCheckStep(0)
POINTS: dict[str, Any] = {"points_mm": [(4.0, 4.0), (70.0, 4.0), (36.0, 36.0)], "touches": 1}


def noted(bench: Bench, config: RigConfig) -> list[Pose]:
    """The rig with that configuration, and the targets that it is sent from now on."""
    sent: list[Pose] = []
    move = bench.move

    async def note(target: Pose, *, speed_mm_s: float, acc_mm_s2: float) -> None:
        sent.append(target)
        await move(target, speed_mm_s=speed_mm_s, acc_mm_s2=acc_mm_s2)

    bench.move = note  # pyright: ignore[reportAttributeAccessIssue]
    bench.rig = replace(bench.rig, config=config)
    return sent


async def down(at: Jogged) -> float | None:
    """Whoever jogs goes down to the end, then says that it touches."""
    return None if at.lowest else -1.0


@pytest.mark.parametrize("method", ["taught", "force", "jog", "camera"])
async def test_no_touch_leaves_what_was_checked(make_bench: MakeBench, method: str) -> None:
    bench = make_bench((0.5, -0.5), paper_z_mm=119.4)
    asked = TouchConfig.model_validate({"method": method, "residual_mm": 9.0, **POINTS})
    config = bench.rig.config.model_copy(update={"touch": asked})
    sent = noted(bench, config)
    await measure_plane(bench.effector, asked, tap=bench.tap, next_jog=down)
    planned = moves_of(config, PaperPlane(config.paper.touch_z_mm), TOUCH)
    if method != "camera":  # whose spots of one patch lie beside each other
        beside = [(a, b) for a, b in pairwise(sent) if math.hypot(b.x_mm - a.x_mm, b.y_mm - a.y_mm) > 1.0]
        assert all(here.z_mm >= config.motion.safe_z_mm for here, _ in beside), "it was lifted before it travelled"
    assert not not_checked(config, sent, planned.segments)
    assert not not_sent(config, planned, sent)


async def test_touches_that_each_find_the_paper_lower_do_not_add_up(make_bench: MakeBench) -> None:
    """The operator jogs to the end of the travel at each of five points: no lower than the plan allowed for."""
    bench = make_bench()
    points = [(x, 4.0) for x in (4.0, 36.0, 68.0, 100.0)]
    asked = TouchConfig.model_validate(
        {"method": "jog", "residual_mm": 9.0, "touches": 1, "points_mm": [*points, (4.0, 60.0)]}
    )
    config = bench.rig.config.model_copy(update={"touch": asked})
    sent = noted(bench, config)
    await measure_plane(bench.effector, asked, next_jog=down)
    planned = moves_of(config, PaperPlane(config.paper.touch_z_mm), TOUCH)
    assert not not_checked(config, sent, planned.segments)
    assert lowest_mm(sent) > 120.0 - asked.travel_mm - 2.1  # what a lean of 1 deg over 116 mm may be


async def test_the_self_check_presses_as_deep_as_was_checked(make_bench: MakeBench) -> None:
    bench = make_bench(whole=True)
    config = bench.rig.config
    sent, plane = noted(bench, config), PaperPlane(120.0)
    sheet = Sheet(config.paper)
    patches = (sheet.patch(0), *partners(sheet, sheet.patch(0), set()))
    await self_check(bench.effector, triangle_on(patches, config.self_check), bench.effector.dip)
    planned = moves_of(config, plane, CHECK, patches)
    assert not not_checked(config, sent, planned.segments)
    assert not not_sent(config, planned, sent)
    assert lowest_mm(sent) == 120.0 - config.self_check.depth_mm


def test_a_touch_that_the_operator_asks_for_by_key_is_checked_before_it(make_bench: MakeBench) -> None:
    """The rig visits a taught height near the arm; by jog it would touch where the arm may not go."""
    config = make_bench().rig.config
    limits = config.robot.limits.model_copy(update={"y_mm": (config.robot.limits.y_mm[0], -20.0)})
    there = config.model_copy(
        update={
            "touch": TouchConfig(points_mm=[(100.0, 4.0)]),
            "robot": config.robot.model_copy(update={"limits": limits}),
        }
    )
    plane = PaperPlane(config.paper.touch_z_mm)
    check_step(Path("rig.toml"), there, plane, TOUCH)
    with pytest.raises(ConfigError, match=r"y = -10\.000 mm is outside .*zero_touch"):
        check_step(Path("rig.toml"), there, plane, replace(TOUCH, method="jog"))
