"""A host that dies in mid-press leaves no brush in the paper: the controller had the lift before the descent began."""

from __future__ import annotations

import asyncio
import itertools
import random
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from brushloop.collect.motion import Procedures
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, make_robot
from brushloop.collect.rig.paper import Sheet
from brushloop.drivers.host import HostClock
from brushloop.drivers.loopback import ask
from brushloop.drivers.sim.config import Table
from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.records import Condition
from tests.waiting import wait_until

PAPER_MM = Table().paper_z_mm
RATE = 4.0
WITHIN_S = 5.0
"""Of the rig's time, from the kill to a brush above the paper."""
PRESS_S = 6.0
"""The same for a whole press, its way there included."""
BELOW_S = 3.0
"""From the beginning of the descent to the brush above the paper again."""


async def press_for_ever(path: Path, seed: int) -> None:
    """Press with only an arm, and say when the first press begins: the process that is killed."""
    rng, config, clock = random.Random(seed), load_rig(path), HostClock()
    robot = make_robot(config, clock, lambda _text: None)
    nothing = cast(Any, None)
    identity = await robot.connect()
    procedures = Procedures(Rig(config, clock, robot, nothing, identity, nothing))
    await robot.enable()
    await procedures.retreat()
    sys.stdout.write("pressing\n")
    sys.stdout.flush()
    sheet = Sheet(config.paper)
    for number in itertools.count():
        patch = sheet.patch(number % sheet.capacity)
        await procedures.press(
            patch, Condition(rng.uniform(5.0, 20.0), rng.uniform(0.0, 14.0)), rng.choice([0.0, 0.2, 0.5])
        )


class OwnRig:
    """A loopback rig in a process of its own: nothing that is killed beside it can hold it up."""

    def __init__(self, folder: Path) -> None:
        self.toml, self.control = folder / "rig.toml", folder / "control"
        command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(self.toml), "--rate", str(RATE)]
        self.process = subprocess.Popen([*command, "--control", str(self.control)], stdout=subprocess.DEVNULL)
        wait_until(self.toml.exists, "rig.toml", process=self.process)

    def state(self) -> tuple[float, float, str]:
        """(simulated seconds, height of the tip above the paper in mm, phase)."""
        state = ask(self.control, {"do": "state"})
        return state["now_s"], state["tip_mm"][2] - PAPER_MM, state["phase"]


@pytest.fixture(scope="module")
def own_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnRig]:
    rig = OwnRig(tmp_path_factory.mktemp("rig"))
    yield rig
    rig.process.terminate()
    rig.process.wait()


def kill(rig: OwnRig, seed: int, when: Callable[[], None]) -> tuple[str, float]:
    """(phase of the arm at the kill, height above the paper in mm `WITHIN_S` later). `when` returns at the moment."""
    command = [sys.executable, "-m", "tests.collect.durability.test_lift", str(rig.toml), str(seed)]
    killed = False
    while not killed:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
            try:
                assert process.stdout is not None
                if process.stdout.readline() == "pressing\n":
                    when()
                    killed = process.poll() is None  # it may end by itself, where the rig has no time to answer it
            finally:
                process.kill()
    killed_s, _, phase = rig.state()
    while True:
        now_s, above_mm, _ = rig.state()
        if now_s >= killed_s + WITHIN_S:
            return phase, above_mm
        time.sleep(0.01)


def until(rig: OwnRig, met: Callable[[float, str], bool]) -> None:
    """Wait for a height above the paper in mm and a phase."""
    wait_until(lambda: met(*rig.state()[1:]), "a height and a phase")


@pytest.mark.parametrize("phase", [pytest.param(Phase.DESCENDING, marks=pytest.mark.soak), Phase.PRESSED])
def test_killed_with_the_brush_in_the_paper_it_lifts_by_itself(own_rig: OwnRig, phase: Phase):
    _, above_mm = kill(own_rig, 1, lambda: until(own_rig, lambda at_mm, now: at_mm < -1.0 and now == phase))
    assert above_mm > 0.5


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_fifty_random_moments_of_presses(own_rig: OwnRig):
    """A third at any moment, the way to the patch included; the others from the beginning of the descent on."""
    rng, at, deep = random.Random(50), Counter[str](), 0
    for number in range(50):
        anywhere = number % 3 == 0
        after_s = rng.uniform(0.0, 2.0 * PRESS_S if anywhere else BELOW_S) / RATE

        def moment(anywhere: bool = anywhere, after_s: float = after_s) -> None:
            nonlocal deep
            if not anywhere:
                until(own_rig, lambda at_mm, _: at_mm < 7.5)
            time.sleep(after_s)
            _, at_mm, phase = own_rig.state()
            at[phase] += 1
            deep += at_mm < 0.0

        _, above_mm = kill(own_rig, number, moment)
        assert above_mm > 0.5, f"kill {number}: the tip is {above_mm:.2f} mm above the paper"
    sys.stdout.write(f"50 kills: {dict(at)}, {deep} with the brush in the paper\n")
    assert deep >= 10


if __name__ == "__main__":
    asyncio.run(press_for_ever(Path(sys.argv[1]), int(sys.argv[2])))
