"""What a benchmark returns, how two contestants are timed fairly, and the processes that a benchmark runs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BRUSHLOOP = (sys.executable, "-m", "brushloop")
# The kernel charges a process with what it held before `exec`, so a command that is started from here would be charged
# with the bench's own memory. A small interpreter of about 10 MB starts it instead.
_STARTER = """
import json, os, sys, time
began = time.monotonic()
child = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
_, status, used = os.wait4(child, 0)
taken = time.monotonic() - began, used.ru_utime + used.ru_stime, used.ru_maxrss, os.waitstatus_to_exitcode(status)
os.write(int(sys.argv[1]), json.dumps(taken).encode())
"""


class BenchError(RuntimeError):
    """A benchmark that could not be measured; the message says what was missing."""


@dataclass(frozen=True, slots=True)
class Result:
    """One measurement beside a peer's.

    `value` is ours in `unit`; `peer` says what the peer is; `ratio` compares the two so that above 1 is better for us;
    `n` is how many rounds were timed and `seed` what the inputs were drawn with. `conditions` says under what
    circumstances. `quickest` and `median` are the ratio by the mean of the quickest tenth of the rounds and by their
    medians, where rounds of both were timed.
    """

    name: str
    value: float
    unit: str
    peer: str
    ratio: float
    n: int
    seed: int
    conditions: str = ""
    quickest: float | None = None
    median: float | None = None

    def to_json(self) -> str:
        """One line of JSON with exactly the fields above."""
        return json.dumps(asdict(self))

    def to_line(self) -> str:
        """One line for people, without the conditions: many results share theirs."""
        value = f"{self.value:,.0f}" if self.value >= 1000 else f"{self.value:.3g}"
        both = "" if self.quickest is None else f"quickest tenth {self.quickest:.2f}, median {self.median:.2f}; "
        return (
            f"{self.name}: {value} {self.unit}, {self.ratio:.2f} x {self.peer} "
            f"(above 1 is better; {both}n = {self.n}, seed = {self.seed})"
        )


def rounds_of(n: int | None, default: int) -> int:
    """The number of rounds. Raises ValueError for n < 1."""
    if n is not None and n < 1:
        raise ValueError(f"n = {n}: at least 1 is needed")
    return default if n is None else n


def at_most(name: str, value: float, unit: str, goal: float, n: int, seed: int, conditions: str = "") -> Result:
    """A figure that should not exceed its goal; ratio = the goal over the figure."""
    ratio = goal / value if value > 0 else float("inf")
    return Result(name, value, unit, f"goal {goal:g} {unit} at most", ratio, n, seed, conditions or machine())


def machine() -> str:
    """What a figure of time depends on and a reader cannot know."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"Python {platform.python_version()}, {os.cpu_count()} cores{load}"


@dataclass(frozen=True, slots=True)
class Turns:
    """The seconds of each round of ours and of the peer's, which took turns."""

    ours_s: tuple[float, ...]
    peer_s: tuple[float, ...]

    @property
    def quickest_s(self) -> tuple[float, float]:
        """The mean of the quickest tenth of the rounds of each: other work on the machine only ever slows."""
        few = max(1, round(0.1 * len(self.ours_s)))
        return statistics.fmean(sorted(self.ours_s)[:few]), statistics.fmean(sorted(self.peer_s)[:few])

    @property
    def median_s(self) -> tuple[float, float]:
        """The median of each."""
        return statistics.median(self.ours_s), statistics.median(self.peer_s)

    def ratios(self, share: float = 1.0) -> tuple[float, float]:
        """`quickest` and `median` of a `Result`: the peer's time over ours, times `share`, by either."""
        (a, b), (c, d) = self.quickest_s, self.median_s
        return share * b / a, share * d / c


def interleave(
    ours: Callable[[], object], peer: Callable[[], object], n: int, clock: Callable[[], float] = time.perf_counter
) -> Turns:
    """Time n rounds of ours, peer, ours, peer...; each runs once unmeasured first.

    Taking turns lets a busy or throttled machine slow both alike. Raises ValueError for n < 1.
    """
    rounds_of(n, n)
    taken: tuple[list[float], list[float]] = ([], [])
    for round_ in range(n + 1):
        for run, times in zip((ours, peer), taken, strict=True):
            began = clock()
            run()
            if round_:
                times.append(clock() - began)
    return Turns(tuple(taken[0]), tuple(taken[1]))


@dataclass(frozen=True, slots=True)
class Used:
    """What a command took: wall and CPU seconds of all its processes, and the most memory that it held, MB (10^6)."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def measure(
    *command: str | Path, code: int = 0, cwd: Path | None = None, environment: Mapping[str, str] | None = None
) -> Used:
    """Run a command to its end. Raises BenchError with its last words if its exit code is not `code`."""
    read, write = os.pipe()
    starter = [sys.executable, "-I", "-S", "-c", _STARTER, str(write), *map(str, command)]
    env = None if environment is None else {**os.environ, **environment}
    ran = subprocess.run(starter, capture_output=True, text=True, check=False, pass_fds=(write,), cwd=cwd, env=env)
    os.close(write)
    with os.fdopen(read) as pipe:
        answer = pipe.read()
    if not answer:
        raise BenchError(f"{command[0]} could not be started: {ran.stderr[-300:]}")
    wall_s, cpu_s, peak_kib, ended = json.loads(answer)
    if ended != code:
        raise BenchError(f"`{' '.join(map(str, command))}` ended with {ended}: {(ran.stderr or ran.stdout)[-300:]}")
    return Used(wall_s, cpu_s, peak_kib * 1024 / 1e6)


def brushloop(*words: str | Path, ends: Container[int] = (0,)) -> subprocess.CompletedProcess[str]:
    """Run a command as an operator does. Raises BenchError unless it ends with one of these exit codes."""
    command = [*BRUSHLOOP, *map(str, words)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if ran.returncode not in ends:
        raise BenchError(f"`{' '.join(command[2:])}` ended with {ran.returncode}: {ran.stderr.strip()[-400:]}")
    return ran


class Process:
    """A running helper: what it said first, and questions to it."""

    def __init__(self, running: subprocess.Popen[str]) -> None:
        self._running = running
        self.pid = running.pid
        self.first = self.answer()

    def answer(self) -> str:
        """Its next line. Raises BenchError where it has ended instead."""
        assert self._running.stdout is not None
        line = self._running.stdout.readline()
        if not line:
            raise BenchError(f"`{' '.join(map(str, self._running.args[1:]))}` ended with {self._running.wait()}")  # pyright: ignore
        return line.strip()

    def ask(self, question: str = "") -> str:
        """Send a line, return the answer."""
        assert self._running.stdin is not None
        self._running.stdin.write(question + "\n")
        self._running.stdin.flush()
        return self.answer()


@contextlib.contextmanager
def started(*arguments: str | Path) -> Iterator[Process]:
    """`python -m` with these arguments, which says a line when it is ready, until the block ends."""
    command = [sys.executable, "-m", *map(str, arguments)]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as running:
        try:
            yield Process(running)
        finally:
            assert running.stdin is not None
            with contextlib.suppress(OSError):
                running.stdin.close()
            try:
                running.wait(10.0)
            except subprocess.TimeoutExpired:
                running.kill()


async def lines_of_input() -> asyncio.StreamReader:
    """Standard input as a stream."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    return reader


def tell(line: str) -> None:
    """One line to whoever started this process."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
