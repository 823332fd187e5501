"""kill -9 at any moment: every step is done exactly once, and no paper patch is used twice."""

import itertools
import random
import subprocess
import sys
import time
from collections import Counter

import pytest

from brushloop.collect.engine.open_or_resume import open_sessions
from brushloop.sessions.recording import Recording

KEYS = [f"step-{number:02d}" for number in range(12)]
KILLS = 10
"""Kills of a session, at most."""

COLLECT = """
import random, sys, time
from pathlib import Path
from brushloop.sessions.events import Condition, Press, PressResult, StepKind
from brushloop.sessions.messages import image_message
from brushloop.sessions.records import Header, Stroke, Topic
from brushloop.sessions.store import SessionStore
from brushloop.sessions.mcap_writer import Outgoing

folder, keys = Path(sys.argv[1]), sys.argv[2:]
header = Header(session_id=folder.name, source="loopback rig", software="test")
if (folder / "journal.jsonl").exists():
    store = SessionStore(folder, time.time_ns)
else:
    store = SessionStore.create(folder, header, {"rig.toml": "x = 1"}, time.time_ns)
print("ready", flush=True)
for key in keys:
    if key in store.state.done:
        continue
    patch = max((patch for _, patch in store.state.used_patches), default=-1) + 1
    attempt = store.begin(key, StepKind.PRESS, patches=(patch,))
    for number in range(4):
        t_ns = time.time_ns()
        still = image_message(t_ns, random.randbytes(20_000))
        attempt.writer.write(Outgoing(Topic.STILL, t_ns, t_ns, number, still))
        time.sleep(random.uniform(0, 0.01))
    stroke = Stroke(stroke_id=key, kind="press", still=3)
    attempt.writer.write(Outgoing(Topic.STROKE, t_ns, t_ns, 3, stroke))
    press = Press(stroke_id=key, condition=Condition(depth_mm=13.0, tilt_deg=5.0), patch=patch)
    store.done(attempt, PressResult(press=press))
store.close()
"""


def run(folder, kill_after_s):
    """One process of the session; True where it came to its end before the kill."""
    child = subprocess.Popen([sys.executable, "-c", COLLECT, folder, *KEYS], stdout=subprocess.PIPE, text=True)
    with child:
        child.stdout.readline()
        if kill_after_s is not None:
            time.sleep(kill_after_s)
            child.kill()
    return child.returncode == 0


def kill_and_finish(make, root, seed, most):
    """Kill a session up to so many times and let it end; returns the number of kills."""
    folder = root / "2026-01-02-grid-01"
    moments = random.Random(seed)
    kills = 0
    while kills < most and not run(folder, moments.uniform(0.0, 0.06)):
        kills += 1
    assert open_sessions(root) == [] or run(folder, None)

    recording = Recording(folder)
    assert make.stroke_names(recording.path) == KEYS
    done = make.events(folder, "done")
    assert Counter(line["key"] for line in done) == Counter(KEYS)
    patches = [patch for line in make.events(folder, "begin") for patch in line["patches"]]
    assert len(patches) == len(set(patches)), "a patch was pressed twice"
    assert sum(line["counts"]["/camera/still"] for line in done) == 48
    return kills


def test_a_session_killed_again_and_again_is_whole_in_the_end(make, tmp_path):
    assert kill_and_finish(make, tmp_path, 4, most=5) > 2, "the kills came too late to test anything"


@pytest.mark.soak
@pytest.mark.timeout(1200)
def test_two_hundred_kills_lose_nothing_and_double_nothing(make, tmp_path):
    kills = 0
    for seed in itertools.count():
        root = tmp_path / str(seed)
        root.mkdir()
        kills += kill_and_finish(make, root, seed, KILLS)
        if kills >= 200:
            return
