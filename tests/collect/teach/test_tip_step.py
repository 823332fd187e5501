"""The step of the tip: holds that were not upright are named on the spot, and asked for again."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brushloop.collect.rig.check import brush_square
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Brought, Target
from brushloop.collect.teach.steps.arm import ArmStep
from brushloop.collect.teach.steps.tip import TipStep
from brushloop.collect.teach.store import Notebook, touch_of
from brushloop.drivers.devices import Pose
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.lab.lab import truth
from tests.collect.teach.person import leaning
from tests.collect.teach.unknown import InLab, in_lab


async def slipped(person: InLab, target: Target, deg: float) -> Brought:
    """The hand holds the brush as ever, but leaning."""
    lab = person.lab
    aim = lab._aims.tip(target.kind, target.index, target.corner)
    lean = Rotation.from_rotvec([math.radians(deg), 0.0, 0.0]) * Rotation.from_quat(aim.quaternion)
    qx, qy, qz, qw = (float(v) for v in lean.as_quat())
    await person._in_lab(lab._hand.guide(Pose(*aim.position_mm, qx, qy, qz, qw), 0.0))
    return Brought.DONE


async def test_holds_that_were_not_upright_are_named_and_asked_for_again(tmp_path: Path) -> None:
    with in_lab(41, rate=30.0, picture_px=(800, 600)) as person:
        bring, hasty = person.bring, [6, 0, 0, 0]

        async def hastily(target: Target, how: str) -> Brought:
            if target.kind != "upright" or hasty[-1:] != [target.index]:
                return await bring(target, how)
            return await slipped(person, target, 9.0) if hasty.pop() == 6 else Brought.DONE  # still at the pin

        person.bring = hastily
        day = Day(person, tmp_path / "rig.toml", HostClock(), armed=False)
        await ArmStep().teach(day)
        await TipStep().teach(day)
    warned = [line.removeprefix("warning: ")[:6] for line in person.lines if line.startswith("warning: Hold ")]
    assert warned == ["Hold 1", "Hold 1", "Hold 1", "Hold 7"]
    assert len(day.notebook.touched("upright")) == 12
    taught = TipStep().derived(day.notebook)["robot.tcp_rotation_deg"]
    assert "12 times" in taught.how
    axis = Rotation.from_euler("ZYX", np.array(taught.value)[::-1], degrees=True).apply([0.0, 0.0, 1.0])
    true = np.array(truth(person.lab.facts, None)["tool"]["brush_axis"])
    assert math.degrees(math.acos(float(axis @ true))) < 0.2


@pytest.mark.parametrize(("count", "tilt_deg"), [(0, 0.0), (2, 0.0), (8, 10.0)])
def test_a_direction_that_too_few_or_scattered_holds_give_is_not_measured_and_not_plausible(
    count: int, tilt_deg: float
) -> None:
    """A scatter of ten degrees must not make a square brush more likely."""
    notebook = Notebook()
    for number in range(8):
        pin = leaning(320.0, 150.0, 90.0, 90.0 * number + 20.0 * (number // 4), 30.0, wrist_deg=0.0)
        notebook = notebook.with_touch(f"pin {number}", touch_of(pin))
    for number in range(count):
        hold = leaning(320.0, 150.0, 90.0, 45.0 * number, tilt_deg, wrist_deg=90.0 * number)
        notebook = notebook.with_touch(f"upright {number}", touch_of(hold))
    taught = TipStep().derived(notebook)["robot.tcp_rotation_deg"]
    assert (taught.value, taught.known) == ([0.0, 0.0, 0.0], "not measured")
    assert brush_square((0.0, 0.0, 0.0)).verdict == "not measured"
