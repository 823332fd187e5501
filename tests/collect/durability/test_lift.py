"""A host that dies in mid-press leaves no brush in the paper: the controller had the lift before the descent began."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from drivers.sim.config import Table
from drivers.sim.fault_cli import ask
from drivers.sim.faults.phases import Phase

PAPER_MM = Table().paper_z_mm
RATE = 4.0
WITHIN_S = 5.0
"""Of the rig's time, from the kill to a brush above the paper."""
PRESS_S = 6.0
"""The same for a whole press, its way there included."""


class OwnRig:
    """A loopback rig in a process of its own: nothing that is killed beside it can hold it up."""

    def __init__(self, folder: Path) -> None:
        self.toml, self.control = folder / "rig.toml", folder / "control"
        command = [sys.executable, "-m", "brushloop", "sim", "--write-rig", str(self.toml), "--rate", str(RATE)]
        self.process = subprocess.Popen([*command, "--control", str(self.control)], stdout=subprocess.DEVNULL)
        deadline = time.monotonic() + 60.0
        while not self.toml.exists():
            assert self.process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)

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
    command = [sys.executable, "-m", "tests.collect.durability.pressing", str(rig.toml), str(seed)]
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


@pytest.mark.parametrize("phase", [Phase.DESCENDING, Phase.PRESSED])
def test_killed_with_the_brush_in_the_paper_it_lifts_by_itself(own_rig: OwnRig, phase: Phase):
    def deep() -> None:
        deadline = time.monotonic() + 60.0
        while (state := own_rig.state())[1] > -1.0 or state[2] != phase:
            assert time.monotonic() < deadline
            time.sleep(0.003)

    _, above_mm = kill(own_rig, 1, deep)
    assert above_mm > 0.5


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_fifty_random_moments_of_presses(own_rig: OwnRig):
    rng, at = random.Random(50), Counter[str]()
    for number in range(50):
        after_s = rng.uniform(0.0, 2.0 * PRESS_S) / RATE
        phase, above_mm = kill(own_rig, number, lambda after_s=after_s: time.sleep(after_s))
        at[phase] += 1
        assert above_mm > 0.5, f"kill {number}, {phase}: the tip is {above_mm:.2f} mm above the paper"
    sys.stdout.write(f"50 kills: {dict(at)}\n")
    assert at[Phase.DESCENDING] + at[Phase.PRESSED] > 5
