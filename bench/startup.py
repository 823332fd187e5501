"""How long the command line takes to answer `--help`, beside the least that its framework allows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from bench.harness import BenchError, Result, interleave

ROOT = Path(__file__).resolve().parent.parent
OURS = (sys.executable, "-m", "brushloop", "--help")
PEER = (sys.executable, "-c", "import typer")


def run(*, n: int | None = None, seed: int = 0) -> Result:
    """Wall seconds of `python -m brushloop --help` beside `python -c "import typer"`.

    ratio = the peer's time over ours, at most about 1: the front door imports typer as well. Nothing is
    drawn, so the seed changes nothing. Raises BenchError when either command fails.
    """
    rounds = 10 if n is None else n
    turns = interleave(lambda: _call(OURS), lambda: _call(PEER), rounds)
    ours_s, peer_s = turns.median_s
    return Result(
        name="startup",
        value=ours_s,
        unit="s",
        peer="import typer",
        ratio=peer_s / ours_s,
        n=rounds,
        seed=seed,
        **turns.ratios(),
    )


def _call(command: tuple[str, ...]) -> None:
    """Run one command to its end; raises BenchError with its last words when it fails."""
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise BenchError(f"`python {' '.join(command[1:])}` exited with {done.returncode}: {last}")
