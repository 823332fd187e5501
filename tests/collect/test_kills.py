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
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from brushloop.collect.protocols.config import load_protocol
from brushloop.drivers.sim.faults import Phase
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.events import CaptureResult
from brushloop.sessions.journal import JOURNAL_NAME, RunState, replay
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke
from brushloop.sessions.verify import verify_session
from tests.journal_lines import read_lines
from tests.rigs import TOUCH_DEPTH_MM, Lab
from tests.waiting import PATIENCE_S, wait_until

LONGEST_LIFE_S = 120.0
START_S, STROKE_S = 3.2, 0.9
"""How long a process takes before its first step, and for each stroke; corrected by what lives really take."""
BELOW_S = 10.0
"""Of the rig's time, that the brush is in the paper in a slow press."""
WITHIN_S = 120.0
"""The same from a kill to the end of whatever it cut: a dwell of a minute included."""
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
    in_paper: int = 0
    """Those of them that left the brush in the paper, from where it lifted by itself."""
    sessions: int = 0


def test_a_session_that_is_killed_three_times_ends_whole(wired_lab: Lab) -> None:
    toll = Toll(random.Random(1))
    while toll.kills < 3:
        session(wired_lab, toll, kills=3 - toll.kills)


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_two_hundred_kills_over_forty_sessions_lose_nothing(wired_lab: Lab) -> None:
    toll = Toll(random.Random(2))
    press_slowly(wired_lab)
    wired_lab.write_protocol(heights="[11.0, 13.0, 15.0]")
    while toll.kills < 200 or toll.sessions < 40:
        session(wired_lab, toll, kills=max(1, -(-(200 - toll.kills) // max(1, 40 - toll.sessions))))
        sys.stdout.write(f"{toll.kills} kills, {toll.in_paper} in the paper, {toll.sessions} sessions, nothing lost\n")
    assert toll.in_paper >= 10


def press_slowly(lab: Lab) -> None:
    """Presses that take a third of a second of the host's time, so that kills strike them."""
    lab.edit_rig("press_speed_mm_s = 20.0", "press_speed_mm_s = 2.0")


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
        life_s = START_S + STROKE_S * strokes_left(lab)
        process, began = lab.process(), time.monotonic()
        if kills > 0:
            wait_for_a_moment(lab, process, toll.rng, toll.pace * life_s)
            if process.poll() is None:
                process.kill()
            in_paper = check_the_brush_lifts(lab)
            _, stderr = process.communicate()
            if process.returncode == -signal.SIGKILL:
                kills -= 1
                toll.kills += 1
                toll.in_paper += in_paper
        else:
            _, stderr = process.communicate(timeout=LONGEST_LIFE_S)
            toll.pace = (time.monotonic() - began) / life_s
        check_nothing_was_taken_back(lab, finished)
        if process.returncode != -signal.SIGKILL:
            assert process.returncode == 0, stderr
        if state(lab).closed is not None:
            break
    check(lab, before)
    toll.sessions += 1


def wait_for_a_moment(lab: Lab, process: subprocess.Popen[str], rng: random.Random, life_s: float) -> None:
    """Wait until some random moment of the process's life, or its end.

    Some moments are drawn evenly from its whole life, the others are aimed at what takes little of it.
    """
    aim = rng.choice(["life", "life", "press", "press", "opening", "step", "close"])
    known, press_s = written(lab), BELOW_S / lab.rig.config.rate
    after_s = rng.uniform(0.0, {"life": life_s, "press": press_s}.get(aim, 0.3))
    deadline = time.monotonic() + LONGEST_LIFE_S

    def until(happened: Callable[[], bool]) -> None:
        while process.poll() is None and not happened():
            assert time.monotonic() < deadline
            time.sleep(0.005)

    match aim:
        case "opening":
            until(lambda: written(lab) > known)
        case "step":
            begun = state(lab).begun + rng.randint(1, 12)
            until(lambda: state(lab).begun >= begun)
        case "press":
            until(lambda: above_mm(lab) < -TOUCH_DEPTH_MM)
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


def written(lab: Lab) -> int:
    """Bytes of the journal."""
    path = journal(lab)
    return 0 if path is None else path.stat().st_size


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


def seen(lab: Lab) -> dict[str, Any]:
    """The state of the world, as the thread that serves the rig sees it."""

    async def look() -> dict[str, Any]:
        return lab.rig.state()

    assert lab.loop is not None
    return asyncio.run_coroutine_threadsafe(look(), lab.loop).result(PATIENCE_S)


def above_mm(lab: Lab) -> float:
    """The height of the tip above the paper."""
    return seen(lab)["tip_mm"][2] - lab.rig.config.table.paper_z_mm


def check_the_brush_lifts(lab: Lab) -> bool:
    """Whether a process that was just killed left the brush in the paper, from where it lifts by itself."""
    left_mm, until_s = above_mm(lab), seen(lab)["now_s"] + WITHIN_S
    wait_until(lambda: not seen(lab)["moving"] or seen(lab)["now_s"] > until_s, "the end of a press")
    assert above_mm(lab) > -TOUCH_DEPTH_MM, "the brush is still in the paper"
    return left_mm < -TOUCH_DEPTH_MM


@pytest.mark.parametrize("phase", [pytest.param(Phase.DESCENDING, marks=pytest.mark.soak), Phase.PRESSED])
def test_killed_with_the_brush_in_the_paper_it_lifts_by_itself(wired_lab: Lab, phase: Phase) -> None:
    press_slowly(wired_lab)
    wired_lab.write_protocol("[15.0]", dwell_s=60.0)
    process = wired_lab.process()
    wait_until(
        lambda: above_mm(wired_lab) < -TOUCH_DEPTH_MM and seen(wired_lab)["phase"] == phase, phase, process=process
    )
    process.kill()
    assert check_the_brush_lifts(wired_lab), "it was no longer in the paper"
