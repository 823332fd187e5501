"""Zero touch by force over the loopback rig's own wires: ARCS for the arm, CAN rounds for the force."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from brushloop.collect.motion.procedures import Procedures
from brushloop.collect.planning.walk import moves_of
from brushloop.collect.protocols.steps import ZeroTouchStep
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.config_touch import TouchConfig
from brushloop.collect.rig.devices import connected
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.touch.arm import ForceTap
from brushloop.collect.touch.measure import measure_plane
from brushloop.drivers.devices import Pose
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.config import SimConfig, Table, View
from brushloop.drivers.sim.rig import LoopbackRig
from tests.collect.sent import not_checked, noting

VIEW = View(width_px=512, height_px=384, px_per_mm=1.56, fps=50.0)
QUICK = {"fast_samples": 12, "medium_samples": 25, "slow_samples": 150, "sigma_mm": 0.03}
"""For a sensor five times quieter than the rig's: averages take real time, whatever the rate of the simulation."""


async def test_a_sheet_that_lies_lower_than_taught_is_found_and_the_brush_is_lifted(tmp_path: Path) -> None:
    table = replace(Table(), paper_z_mm=119.3, slope_deg=(0.5, -0.5))
    sim = SimConfig(rate=60.0, table=table, view=VIEW, force_noise_n=0.0004)
    async with LoopbackRig(sim) as loopback:
        text = loopback.toml().replace("latency_ms = 250.0", "latency_ms = 60.0")
        (tmp_path / "rig.toml").write_text(text.replace("touch_z_mm = 119.330", "touch_z_mm = 120.0"), encoding="utf-8")
        config = load_rig(tmp_path / "rig.toml")
        async with connected(config, HostClock(), lambda _notice: None) as rig:
            assert rig.force is not None
            await rig.robot.enable()
            sent: list[Pose] = []
            noting(loopback.world.motion, sent.append)
            await rig.force.bias(0.5)
            touch = TouchConfig(method="force", touches=2, force=QUICK)  # pyright: ignore[reportArgumentType]
            tap = ForceTap()
            rig.force.listen(tap.take)
            result = await measure_plane(rig, Procedures(rig), touch, tap=tap)
            at_mm = (await rig.robot.where()).position_mm

    asked = config.model_copy(update={"touch": touch})
    planned = moves_of(asked, PaperPlane(config.paper.touch_z_mm), ZeroTouchStep(0), None)
    assert len(sent) > 10
    assert not not_checked(config, sent, planned.parts)
    [point] = result.points
    truth_mm = table.surface_z_mm(*config.paper.touch_point_mm)
    assert [t.z_mm for t in point.touches] == pytest.approx([truth_mm] * 2, abs=0.12)
    assert all(t.sigma_mm is not None and t.sigma_mm <= 0.03 for t in point.touches)
    assert at_mm[2] == pytest.approx(config.motion.safe_z_mm, abs=0.01)
