"""How long commands take until their work begins, and the front door beside the least that its framework allows."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.harness import BenchError, Result, interleave, machine
from bench.peak import measure

ROOT = Path(__file__).resolve().parent.parent
OURS = (sys.executable, "-m", "brushloop", "--help")
PEER = (sys.executable, "-c", "import typer")
IMPORTED = (
    sys.executable,
    "-c",
    "import time; began_s = time.perf_counter(); import brushloop; print(time.perf_counter() - began_s)",
)
IMPORT_GOAL_S = 0.06
GOAL_S = 0.8
COMMANDS = {
    "collect": "collect --config no.toml --protocol no.toml --no-tui",
    "collect plan": "collect plan --config no.toml --protocol no.toml",
    "doctor": "doctor --config no.toml",
    "calibrate": "calibrate nowhere",
    "fit": "fit nowhere",
    "validate": "validate nowhere",
    "invert": "invert nowhere",
    "loop": "loop nowhere --config no.toml",
    "write": "write 字 --config no.toml",
    "sessions export": "sessions export nowhere out",
    "sessions import": "sessions import nowhere --csv no.csv",
    "sim": "sim --write-rig no/rig.toml",
}
"""Each is timed until it refuses a file that is not there: everything that comes before its work."""


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Wall seconds of `python -m brushloop --help` beside `python -c "import typer"`, and CPU seconds of each command.

    `startup.import` is what `import brushloop` adds to a notebook, in wall seconds within Python.

    ratio = the peer's time over ours, at most about 1 for `--help`: the front door imports typer as well. `n` rounds,
    10 by default, a third of them for the commands. Nothing is drawn, so the seed changes nothing. Raises BenchError
    when a command does not end as it should.
    """
    rounds = 10 if n is None else n
    turns = interleave(lambda: _call(OURS), lambda: _call(PEER), rounds)
    ours_s, peer_s = turns.median_s
    asked = Result("startup", ours_s, "s", "import typer", peer_s / ours_s, rounds, seed, **turns.ratios())
    import_s = statistics.median(float(_call(IMPORTED)) for _ in range(rounds))
    goal = f"goal {IMPORT_GOAL_S:g} s at most"
    imported = Result("startup.import", import_s, "s", goal, IMPORT_GOAL_S / import_s, rounds, seed, machine())
    return [asked, imported, *_starts(max(1, rounds // 3), seed)]


def _starts(rounds: int, seed: int) -> Iterator[Result]:
    where = f"until a file that is not there is refused; {machine()}"
    with tempfile.TemporaryDirectory() as folder:
        for name, words in COMMANDS.items():
            command = (sys.executable, "-m", "brushloop", *words.split())
            measure(*command, code=2, cwd=Path(folder))  # unmeasured: compiles what it imports, as after the first use
            cpu_s = statistics.median(measure(*command, code=2, cwd=Path(folder)).cpu_s for _ in range(rounds))
            goal = f"goal {GOAL_S:g} s at most"
            yield Result(f"startup.{name}", cpu_s, "CPU-s", goal, GOAL_S / cpu_s, rounds, seed, where)


def _call(command: tuple[str, ...]) -> str:
    """Run one command to its end and return what it printed; raises BenchError with its last words when it fails."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise BenchError(f"`python {' '.join(command[1:])}` exited with {done.returncode}: {last}")
    return done.stdout
