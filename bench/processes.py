"""Processes beside a bench: commands as an operator runs them, and helpers that are asked line by line."""

from __future__ import annotations

import asyncio
import contextlib
import subprocess
import sys
from collections.abc import Container, Iterator
from pathlib import Path

from bench.harness import BenchError

ROOT = Path(__file__).resolve().parent.parent


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
def started(*arguments: str) -> Iterator[Process]:
    """`python -m` with these arguments, until the block ends."""
    command = [sys.executable, "-m", *arguments]
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


def brushloop(*words: str | Path, ends: Container[int] = (0,)) -> subprocess.CompletedProcess[str]:
    """Run a command as an operator does. Raises BenchError unless it ends with one of these exit codes."""
    command = [sys.executable, "-m", "brushloop", *map(str, words)]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if ran.returncode not in ends:
        raise BenchError(f"`{' '.join(command[2:])}` ended with {ran.returncode}: {ran.stderr.strip()[-400:]}")
    return ran


async def lines_of_input() -> asyncio.StreamReader:
    """Standard input as a stream."""
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    return reader


def tell(line: str) -> None:
    """One line to whoever started this process."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
