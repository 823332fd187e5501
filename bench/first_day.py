"""`python -m bench.first_day [OUT] [--seed N]`: the whole first day on its screen in an unknown lab, with pictures.

The wizard is the real one; the person's hand is that of the simulated lab. Every answer is pressed as a key.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import chdir, contextmanager
from pathlib import Path

from textual.pilot import Pilot

from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Target
from brushloop.collect.teach.watch import watched
from brushloop.collect.teach.wizard import Wizard
from brushloop.collect.tui.teach_app import TeachApp
from brushloop.collect.tui.teach_guide import Question, ScreenGuide
from brushloop.drivers.clock import HostClock
from brushloop.drivers.sim.lab.lab import UnknownLab

SIZE = (120, 34)
RATE = 4.0
WAIT_S = 1800.0
"""Longest time between two questions: the runs of the proof ask nothing while the brush feels for the paper."""
PICTURES = {
    "address of the cabinet": "arm",
    "hold the board": "camera",
    "touch 3": "tip",
    "upper right corner of the sheet": "sheet",
    "middle of the well": "places",
    "l: length": "brush",
    "push the tip": "force",
    "robot.limits.z_mm": "limits",
    "dry run": "proof",
}
"""Words of a question, in small letters, and the picture that is taken of it."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m bench.first_day", description="Take pictures of the first day.")
    parser.add_argument("out", nargs="?", type=Path, default=Path("docs/screens"))
    parser.add_argument("--seed", type=int, default=3)
    given = parser.parse_args(arguments)
    out: Path = given.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch), _serving(given.seed) as (lab, loop):
        return asyncio.run(_day(lab, loop, out))


@contextmanager
def _serving(seed: int) -> Iterator[tuple[UnknownLab, asyncio.AbstractEventLoop]]:
    ready: Future[tuple[UnknownLab, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        async with UnknownLab(seed, rate=RATE) as lab:
            ready.set_result((lab, asyncio.get_running_loop(), over))
            await over.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="unknown lab")
    thread.start()
    lab, loop, over = ready.result(timeout=60)
    try:
        yield lab, loop
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()


class _Person:
    """Reads each question, does by hand what it asks for, and presses keys."""

    def __init__(self, app: TeachApp, pilot: Pilot[None], lab: UnknownLab, loop: asyncio.AbstractEventLoop) -> None:
        self._app, self._pilot, self._lab, self._loop = app, pilot, lab, loop
        self._number = 0
        self._held = 0

    async def question(self) -> Question | None:
        """The next question; None once the day is over."""
        deadline = time.monotonic() + WAIT_S
        while time.monotonic() < deadline:
            await self._pilot.pause(0.2)
            if self._app.teaching.finished:
                return None
            question = self._app.teaching.guide.view.question
            if question is not None and question.number > self._number and self._app.asking:
                self._number = question.number
                await self._pilot.pause(0.5)
                return question
        raise TimeoutError(f"no question in {WAIT_S:g} s")

    async def answer(self, question: Question) -> None:
        """Answer it as somebody would who reads it for the first time."""
        if question.target is not None:
            await self._bring(question.target)
            await self._pilot.press("enter")
        elif question.kind in ("text", "number"):
            for letter in self._typed(question.text.lower()):
                await self._pilot.press(letter)
            await self._pilot.press("enter")
        else:
            await self._pilot.press(self._chosen(question))

    async def _bring(self, target: Target) -> None:
        index = self._held if target.kind == "hold-board" else target.index
        self._held += target.kind == "hold-board"
        act = self._lab.bring(target.kind, index, target.corner)
        await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(act, self._loop))

    def _typed(self, words: str) -> str:
        seen = self._lab.seen()
        host, port, bus = seen.can
        answers = {
            "address of the cabinet": seen.host,
            "stream": " ".join(seen.streams),
            "longer side": str(seen.squares[0]),
            "shorter side": str(seen.squares[1]),
            "side of a square": f"{seen.square_mm:g}",
            "side of a marker": f"{seen.marker_mm:g}",
            "r: radius": f"{seen.radius_mm:g}",
            "l: length": f"{seen.length_mm:g}",
            "can bus": f"{host}:{port}/{bus}",
            "serial line": "" if seen.ink is None else seen.ink[1],
        }
        return next((answer for part, answer in answers.items() if part in words), "")

    def _chosen(self, question: Question) -> str:
        """The key that lets the arm move, what fills the well, and yes to what is offered; otherwise no."""
        if "moves by itself" in question.text:
            return "a"
        if "well filled" in question.text:
            ink = self._lab.seen().ink
            return "n" if ink is None else "i" if ink[0] == "ink-station" else "p"
        return "enter" if question.default else "y" if "Agreed?" in question.text else "n"


async def _day(lab: UnknownLab, loop: asyncio.AbstractEventLoop, out: Path) -> int:
    rig = Path("rig.toml")

    async def work(guide: ScreenGuide) -> Path | None:
        day = Day(guide, rig, HostClock(), armed=True)
        async with watched(day, guide.see_pose, guide.see_picture, lambda: guide.looking):
            return await Wizard(day).run()

    app, taken = TeachApp(work, str(rig)), set[str]()
    async with app.run_test(size=SIZE) as pilot:
        person = _Person(app, pilot, lab, loop)
        while (question := await person.question()) is not None:
            if question.text.startswith("How to go on"):
                raise RuntimeError("\n".join(app.teaching.guide.view.findings[-1].lines))
            words = question.text.lower()
            for name in (name for part, name in PICTURES.items() if part in words and name not in taken):
                taken.add(name)
                _take(app, out, name)
            sys.stdout.write(f"{question.text}\n")
            await person.answer(question)
        await pilot.pause(0.5)
        _take(app, out, "ready")
        for shown in app.teaching.guide.view.findings[-8:]:
            sys.stdout.write("\n".join(shown.lines) + "\n")
    app.teaching.join()
    return 0


def _take(app: TeachApp, out: Path, name: str) -> None:
    title = f"brushloop rig new, loopback rig: {name}"
    (out / f"first-day-{name}.svg").write_text(app.export_screenshot(title=title), encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
