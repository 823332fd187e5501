"""Kill -9 at random moments, again and again: every stroke exactly once, no patch twice, nothing lost; and a host that
dies in mid-press leaves no brush in the paper.

A session is judged by the journal, by the loopback world's own answer sheet, and by reading every file of it again.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pytest

from brushloop.collect.motion import Procedures
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, make_robot
from brushloop.collect.rig.paper import Sheet
from brushloop.drivers.host import HostClock
from brushloop.drivers.loopback import ask
from brushloop.drivers.sim.config import Table
from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.events import CaptureResult
from brushloop.sessions.journal import JOURNAL_NAME, RunState, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Condition, Stroke
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines
from tests.waiting import wait_until

if TYPE_CHECKING:
    from tests.rigs import Lab

LONGEST_LIFE_S = 120.0
START_S, STROKE_S = 3.2, 0.9
"""How long a process takes before its first step, and for each stroke; corrected by what lives really take."""
SAME_SPOT_MM = 10.0
"""Patches are at least 24 mm apart."""


@dataclass
class Toll:
    """What a run of killing came to."""

    rng: random.Random
    pace: float = 1.0
    """How much longer lives are than expected on this machine now."""
    kills: int = 0
    """Of living processes."""
    sessions: int = 0


@pytest.fixture
def lab(wired_lab: Lab) -> Lab:
    return wired_lab


def test_a_session_that_is_killed_three_times_ends_whole(lab: Lab) -> None:
    toll = Toll(random.Random(1))
    while toll.kills < 3:
        session(lab, toll, kills=3 - toll.kills)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_two_hundred_kills_over_forty_sessions_lose_nothing(lab: Lab) -> None:
    toll = Toll(random.Random(2))
    lab.write_protocol(heights="[11.0, 13.0, 15.0]")
    while toll.kills < 200 or toll.sessions < 40:
        session(lab, toll, kills=max(1, -(-(200 - toll.kills) // max(1, 40 - toll.sessions))))
        sys.stdout.write(f"{toll.kills} kills, {toll.sessions} sessions, nothing lost\n")


def session(lab: Lab, toll: Toll, kills: int) -> None:
    """One session from its first process to its merged file, with up to this many kills on the way."""
    lab = replace(lab, folder=lab.folder / f"{toll.sessions:03d}", processes=lab.processes)
    lab.folder.mkdir()
    for name in ("rig.toml", "protocol.toml"):
        (lab.folder / name).write_bytes((lab.folder.parent / name).read_bytes())
    lab.rig.world.fresh_sheet()
    before = len(lab.presses)
    finished: dict[str, str] = {}
    while True:
        known = events(lab)
        life_s = START_S + STROKE_S * strokes_left(lab)
        process, began = lab.process(), time.monotonic()
        if kills > 0:
            wait_for_a_moment(lab, process, toll.rng, toll.pace * life_s, len(known))
            if process.poll() is None:
                process.kill()
            _, stderr = process.communicate()
            if process.returncode == -signal.SIGKILL:
                kills -= 1
                toll.kills += 1
        else:
            _, stderr = process.communicate(timeout=LONGEST_LIFE_S)
            toll.pace = (time.monotonic() - began) / life_s
        check_nothing_was_taken_back(lab, finished)
        if process.returncode != -signal.SIGKILL:
            assert process.returncode == 0, stderr
        if "closed" in events(lab):
            break
    check(lab, before)
    toll.sessions += 1


def wait_for_a_moment(lab: Lab, process: subprocess.Popen[str], rng: random.Random, life_s: float, known: int) -> None:
    """Wait until some random moment of the process's life, or its end.

    Half of the moments are drawn evenly from its whole life, half are aimed at what takes little of it.
    """
    aim = rng.choice(["life", "life", "life", "opening", "step", "close"])
    after_s = rng.uniform(0.0, life_s if aim == "life" else 0.3)
    deadline = time.monotonic() + LONGEST_LIFE_S

    def until(happened: Callable[[], bool]) -> None:
        while process.poll() is None and not happened():
            assert time.monotonic() < deadline
            time.sleep(0.005)

    match aim:
        case "opening":
            until(lambda: len(events(lab)) > known)
        case "step":
            begun = rng.randint(1, 12)
            until(lambda: events(lab)[known:].count("begin") >= begun)
        case "close":
            until(lambda: strokes_left(lab) == 0)
        case _:
            pass
    end = time.monotonic() + after_s
    until(lambda: time.monotonic() >= end)


def journal(lab: Lab) -> Path | None:
    """Of the session that was begun; a process that died before the first line leaves an empty one behind."""
    found = [path for path in lab.sessions.glob(f"*/{JOURNAL_NAME}") if replay(path).opened is not None]
    assert len(found) <= 1, f"more than one session: {found}"
    return found[0] if found else None


def events(lab: Lab) -> list[str]:
    path = journal(lab)
    return [] if path is None else [str(line["event"]) for line in read_lines(path)]


def state(lab: Lab) -> RunState:
    path = journal(lab)
    return RunState() if path is None else replay(path)


def stroke_ids(lab: Lab) -> list[str]:
    return sorted(press.stroke_id for press in load_protocol(lab.folder / "protocol.toml").planned())


def strokes_left(lab: Lab) -> int:
    return len(stroke_ids(lab)) - len(captures_done(state(lab)))


def captures_done(state: RunState) -> list[str]:
    return sorted(capture.press.stroke_id for capture in state.results(CaptureResult))


def check_nothing_was_taken_back(lab: Lab, finished: dict[str, str]) -> None:
    """Every step that the journal ever called done is still called so, and its file holds the same bytes."""
    now = {step.file: step.sha256 for step in state(lab).files.values()}
    assert finished.items() <= now.items()
    assert {name: file_sha256(next(lab.sessions.glob(f"*/{name}"))) for name in now} == now
    finished.update(now)


def check(lab: Lab, presses_before: int) -> None:
    """The session is whole: its journal, its files, its merged recording, and what really lies on the paper."""
    path = journal(lab)
    assert path is not None
    state = replay(path)
    assert not state.is_open
    wanted = stroke_ids(lab)
    assert captures_done(state) == wanted
    begun = [line for line in read_lines(path) if line["event"] == "begin" and line["patches"]]
    patches = [(line["sheet"], line["patches"][0]) for line in begun]
    assert len(patches) == len(set(patches)), "a patch was used twice"

    verdict = verify_session(path.parent)
    assert verdict.sound, verdict.findings
    assert verdict.files == len(state.files) + 1
    recording = Recording(path.parent)
    strokes = [capture.stroke for capture in recording.captures() if capture.image().size]
    assert sorted(stroke.stroke_id for stroke in strokes) == wanted
    check_paper(lab, strokes, presses_before, len(patches))


def check_paper(lab: Lab, strokes: list[Stroke], presses_before: int, begun: int) -> None:
    presses = lab.presses[presses_before:]
    for one, other in itertools.combinations(presses, 2):
        assert math.dist((one.x_mm, one.y_mm), (other.x_mm, other.y_mm)) > SAME_SPOT_MM, "pressed on wet ink"
    assert len(strokes) <= len(presses) <= begun
    for stroke in strokes:
        assert stroke.anchor_mm is not None
        [press] = [p for p in presses if math.dist((p.x_mm, p.y_mm), stroke.anchor_mm) < SAME_SPOT_MM]
        assert press.depth_mm == pytest.approx(stroke.depth_mm, abs=0.1)
        assert press.tilt_deg == pytest.approx(stroke.tilt_deg, abs=0.1)
        assert press.ink_load == 1.0, "not dipped before it"


# A press that nobody watches any more: the controller had the lift before the descent began

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
    command = [sys.executable, "-m", "tests.collect.test_kills", str(rig.toml), str(seed)]
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


def until_arm(rig: OwnRig, met: Callable[[float, str], bool]) -> None:
    """Wait for a height above the paper in mm and a phase."""
    wait_until(lambda: met(*rig.state()[1:]), "a height and a phase")


@pytest.mark.parametrize("phase", [pytest.param(Phase.DESCENDING, marks=pytest.mark.soak), Phase.PRESSED])
def test_killed_with_the_brush_in_the_paper_it_lifts_by_itself(own_rig: OwnRig, phase: Phase):
    _, above_mm = kill(own_rig, 1, lambda: until_arm(own_rig, lambda at_mm, now: at_mm < -1.0 and now == phase))
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
                until_arm(own_rig, lambda at_mm, _: at_mm < 7.5)
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
