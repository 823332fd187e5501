"""The first day in labs that nobody has measured, by a person who knows what is printed there and nothing else."""

from __future__ import annotations

import asyncio
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from collect.errors import CollectAborted
from collect.teach.day import Day, Step
from collect.teach.steps import all_steps
from collect.teach.wizard import Wizard
from drivers.arcs.rpc import RpcConnection
from drivers.clock import HostClock
from drivers.sim.lab.traps import Trap
from tests.collect.teach.lab_person import Lab, LabPerson, served

RATE = 20.0
LABS: list[tuple[int, Trap | None]] = [(seed, None) for seed in range(20)] + list(enumerate(Trap, 20))
"""Thirty labs; the last ten have one trap each."""


@pytest.fixture(autouse=True)
def busy(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the known rig's file: pictures and rounds come from this machine, and simulated time is fast."""
    for name, value in {
        "CAMERA__MAX_JITTER_MS": "2000",
        "CAMERA__MAX_DELAY_MS": "5000",
        "FORCE__STALE_MS": "2000",
        "MOTION__LEAST_DWELL_S": f"{0.05 * RATE}",
    }.items():
        monkeypatch.setenv(f"BRUSHLOOP_{name}", value)


@dataclass
class FirstDay:
    """One person's day in one lab."""

    lab: Lab
    person: LabPerson
    day: Day

    def lead(self, *names: str) -> None:
        """Teach these steps, or all of them; the person leaves after trouble that nothing can be done about."""
        steps: tuple[Step, ...] = tuple(step for step in all_steps() if not names or step.name in names)
        asyncio.run(_led(Wizard(self.day, steps), self.person, whole=not names))

    def found(self, name: str) -> Any:
        return self.day.notebook.get(name)

    @property
    def tip_off_mm(self) -> float:
        return float(
            np.linalg.norm(np.subtract(self.found("robot.tcp_offset_mm"), self.lab.truth()["tool"]["tcp_offset_mm"]))
        )


async def _led(wizard: Wizard, person: LabPerson, *, whole: bool) -> None:
    try:
        for step in wizard._steps:
            if step.name not in wizard._day.notebook.done:
                await wizard._taught(step)
        if whole:
            await wizard.run()
    except CollectAborted:
        if person.square_mm is None:
            return
        await wizard.again("camera")  # the way out that was named: the print with its measured size
        await wizard.run()


@pytest.fixture
def first_day(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[FirstDay]:
    """In the lab of the seed and the trap that the test names."""
    seed, trap = request.param
    with served(seed, trap, tmp_path, RATE) as lab:
        person = LabPerson(lab, trap)
        yield FirstDay(lab, person, Day(person, tmp_path / "rig.toml", HostClock(), armed=True))


@pytest.mark.parametrize("first_day", [(2, None)], indirect=True)
def test_the_tip_is_found_by_touching_a_pin(first_day: FirstDay):
    first_day.lead("arm", "tip")
    assert set(first_day.day.notebook.done) == {"arm", "tip"}
    assert first_day.tip_off_mm < 0.5
    assert first_day.person.typed == {}


@pytest.mark.parametrize("first_day", [(28, Trap.OLD_SOFTWARE)], indirect=True)
def test_the_older_software_is_named_and_after_its_upgrade_the_arm_is_found(first_day: FirstDay):
    first_day.lead("arm")
    assert first_day.person.names(Trap.OLD_SOFTWARE)
    assert first_day.person.mended
    assert set(first_day.day.notebook.done) == {"arm"}


@pytest.mark.parametrize("first_day", [(29, Trap.CABLE_PULLED)], indirect=True)
def test_a_cable_pulled_in_mid_step_costs_no_touch(first_day: FirstDay, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(RpcConnection.__init__.__kwdefaults__, "timeout_s", 1.0)
    first_day.lead("arm", "tip")
    assert first_day.person.names(Trap.CABLE_PULLED)
    assert "it is in again" in first_day.person.mended[0]
    assert set(first_day.day.notebook.done) == {"arm", "tip"}
    assert first_day.tip_off_mm < 0.5


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("first_day", LABS, indirect=True, ids=[f"{s}-{t or 'none'}" for s, t in LABS])
def test_the_first_day_ends_with_a_rig_that_presses_true(first_day: FirstDay, request: pytest.FixtureRequest):
    [(_, trap)] = [lab for lab in LABS if f"{lab[0]}-{lab[1] or 'none'}" == request.node.callspec.id]
    first_day.lead()
    person, known = first_day.person, first_day.lab.truth()
    said = "\n".join(person.lines[-12:])
    assert trap is None or person.names(trap), said
    assert "READY" in person.lines, said
    x_off, y_off = np.subtract(first_day.found("paper.origin_mm"), known["paper"]["origin_mm"])
    yaw_off_deg = math.remainder(first_day.found("paper.yaw_deg") - known["paper"]["yaw_deg"], 360.0)
    delay_s, true_s = first_day.found("camera.latency_ms") / 1e3, known["camera"]["delay_s"]
    sys.stdout.write(
        f"tcp {first_day.tip_off_mm:.2f} mm, origin {math.hypot(x_off, y_off):.2f} mm, yaw {yaw_off_deg:+.3f} deg, "
        f"touch {touch_off_mm(first_day):+.3f} mm, delay {delay_s:.2f} of {true_s:.2f} s\n"
    )
    assert first_day.tip_off_mm < 0.5
    assert math.hypot(x_off, y_off) < 0.5
    assert abs(yaw_off_deg) < 0.2
    assert abs(touch_off_mm(first_day)) < 0.1
    assert delay_s == pytest.approx(true_s, rel=0.2)
    assert {question.split(":")[0] for question in person.typed} <= {
        *("R", "L", "Deepest press that this brush can take", "Delivery per revolution, by weighing ten of them"),
        *("Squares along its longer side, as printed", "Squares along its shorter side, as printed"),
        *("Side of a square (ten of them by calipers)", "Side of a marker"),
    }


def touch_off_mm(first_day: FirstDay) -> float:
    """The height found at the touch point, less the true one."""
    paper = first_day.lab.truth()["paper"]
    x, y = first_day.found("paper.touch_point_mm")
    nx, ny, nz = paper["normal"]
    return first_day.found("paper.touch_z_mm") - (paper["touch_z_mm"] - (nx * x + ny * y) / nz)
