"""`python -m bench.judged [SEED [CAMERA...]]`: whole sessions over late and stalling cameras, judged for ink.

Ten sessions of 30 strokes on the loopback rig, one for each camera of `bench.photographs`, collected by `brushloop
collect` in a process of its own. A photograph with the arm in it, or of the sheet as it was before, shows as a stroke
that is misplaced or not there. A run that ends with a question is started again a few times, as an operator would.
"""

from __future__ import annotations

import asyncio
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from bench.harness import machine
from bench.photographs import EACH, Case, busy, cases, serve, stop
from bench.processes import ROOT, started, tell

MOST_STARTS = 4
"""A camera that is refused so often stays refused."""
MOST_STARTS_WITH_STOPS = 40
"""A rig that is silent for longer than its driver waits ends a run; the same command resumes."""
BETWEEN_STOPS_S = (8.0, 20.0)
LONGEST_S = 1200.0
PROTOCOL = """kind = "grid"
depths_mm = [11.0, 13.0, 15.0, 17.0, 20.0]
tilts_deg = [0.0, 5.0, 10.0]
repeats = 2
seed = {seed}
"""


def full_size(case: Case) -> Case:
    """The case with a camera sharp enough to judge strokes, and no time in its picture."""
    sharp = {"width_px": 2048, "height_px": 1536, "px_per_mm": 6.25, "stamp_strip": False}
    return replace(case, view=replace(case.view, **sharp))


def collect(folder: Path, rig_pid: int, stops: str, seed: int) -> list[str]:
    """Collect until the session is closed, or it has asked too often. Returns what each start ended with, if it did."""
    command = [sys.executable, "-m", "brushloop", "collect", "--no-tui", "--config", str(folder / "rig.toml")]
    command += ["--protocol", str(folder / "protocol.toml"), "--out", str(folder / "sessions")]
    ended: list[str] = []
    rng = random.Random(seed)
    for _ in range(MOST_STARTS_WITH_STOPS if stops else MOST_STARTS):
        log = folder / "stderr.txt"
        with log.open("w") as err, subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=err) as run:
            pid = {"rig": rig_pid, "collect": run.pid}.get(stops)
            until = time.monotonic() + LONGEST_S
            while run.poll() is None and time.monotonic() < until:
                time.sleep(rng.uniform(*BETWEEN_STOPS_S) if pid is not None else 0.5)
                if pid is not None:
                    stop(pid)
            run.kill()
        if run.returncode == 0:
            break
        ended.append(log.read_text().strip().split("\n")[-1][:160])
    return ended


def results(folder: Path) -> list[dict[str, Any]]:
    """What the journal says of every capture that was done."""
    lines = [json.loads(line) for path in folder.glob("sessions/*/journal.jsonl") for line in path.open()]
    captures = {line["key"] for line in lines if line["event"] == "begin" and line["kind"] == "capture"}
    return [line["result"] for line in lines if line["event"] == "done" and line["key"] in captures]


def measure(number: int, case: Case, seed: int) -> tuple[str, int, int]:
    """One line of the table, the number of captures, and how many of them were called misplaced or empty."""
    with tempfile.TemporaryDirectory() as name, busy(case.loops):
        folder = Path(name)
        (folder / "protocol.toml").write_text(PROTOCOL.format(seed=seed))
        with started("bench.judged", "rig", str(folder / "rig.toml"), str(number)) as rig:
            began = time.monotonic()
            ended = collect(folder, rig.pid, case.stops, seed)
            took_s = time.monotonic() - began
        done = results(folder)
    verdicts = Counter(result["verdict"] for result in done)
    wrong = verdicts["misplaced"] + verdicts["blank"]
    measured_ms = sorted({f"{result['camera_delay_ms']:.0f}" for result in done if "camera_delay_ms" in result})
    others = ", ".join(f"{count} {name}" for name, count in verdicts.items() if name) or "none"
    refusals = "; ".join(f"{count} x {text}" for text, count in Counter(ended).most_common()) or "none"
    line = f"| {case.name} | {len(done)} | {wrong} | {others} | {', '.join(measured_ms)} | {took_s:.0f} | {refusals} |"
    return line, len(done), wrong


def main(seed: int, only: list[int]) -> None:
    """Measure the cameras with these numbers (all if there are none), and print the table."""
    tell(f"Judged captures on the loopback rig, {EACH} strokes a camera, seed {seed}, {machine()}")
    tell("| camera | captures | misplaced or empty | all findings | measured delay, ms | s | runs that ended early |")
    tell("|---|---|---|---|---|---|---|")
    captures = wrong = 0
    for number, case in enumerate(cases()):
        if only and number not in only:
            continue
        line, done, bad = measure(number, case, seed)
        captures, wrong = captures + done, wrong + bad
        tell(line)
    tell(f"{captures} captures, {wrong} called misplaced or empty")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["rig", path, number]:
            asyncio.run(serve(Path(path), full_size(cases()[int(number)]).view))
        case numbers:
            seed, *only = map(int, numbers or ["0"])
            main(seed, only)
