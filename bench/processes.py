"""The other ends that `bench rpc` measures against, each in a process of its own.

`python -m bench.processes controller FILE RATE` serves the loopback rig and writes its rig.toml; each line on its
input is answered with the presses that the sheet has seen. `python -m bench.processes echo` sends back what it gets.
Both say on one line where they listen, and end when their input does.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
from collections.abc import Container, Iterator
from pathlib import Path

from bench.harness import BenchError

ROOT = Path(__file__).resolve().parent.parent
HOST = "127.0.0.1"


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


async def _controller(path: Path, rate: float) -> None:
    from brushloop.drivers.sim.config import SimConfig
    from brushloop.drivers.sim.rig import LoopbackRig

    async with LoopbackRig(SimConfig(rate=rate, force_sensor=False, ink_device="none")) as rig:
        path.write_text(rig.toml(), encoding="utf-8")
        questions = await lines_of_input()
        tell("ready")
        while await questions.readline():
            tell(json.dumps([[press.depth_mm, press.ink_load] for press in rig.world.presses]))


async def _echo() -> None:
    async def back(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(65536):
            writer.write(data)
        writer.close()

    server = await asyncio.start_server(back, HOST, 0)
    async with server:
        questions = await lines_of_input()
        tell(str(server.sockets[0].getsockname()[1]))
        await questions.read()


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["controller", path, rate]:
            asyncio.run(_controller(Path(path), float(rate)))
        case ["echo"]:
            asyncio.run(_echo())
        case other:
            sys.exit(f"unknown arguments {other}")
