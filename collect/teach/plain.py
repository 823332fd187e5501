"""The first day in a terminal, line by line: questions on the standard output, answers from the standard input."""

from __future__ import annotations

import asyncio
import os
import select
import threading
from collections.abc import Callable
from pathlib import Path

from collect.operator import Choice
from collect.teach.guide import Brought, JogStep, JogView, LeftOff, Shown, StepState, Target, WentBack, number_in
from sessions.terminal import say

BACK, SKIP, JOG, QUIT = "back", "skip", "jog", "quit"
MARKS = {"open": "  ", "current": "->", "taught": "ok"}
LOOK_S = 0.1
"""Interval at which a wait for a line checks whether it was ended."""


class Lines:
    """Lines from a file descriptor, read so that a wait for one can be ended: ctrl-c must not hang until Enter."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._held = b""
        self._ended = threading.Event()

    def read(self) -> str | None:
        """The next line; None at the end of the input, and after `end`. Blocks."""
        while b"\n" not in self._held and not self._ended.is_set():
            if not select.select([self._descriptor], [], [], LOOK_S)[0]:
                continue
            if not (part := os.read(self._descriptor, 4096)):
                break
            self._held += part
        if self._ended.is_set() or not self._held:
            return None
        line, _, self._held = self._held.partition(b"\n")
        return line.decode(errors="replace").rstrip("\r")

    def end(self) -> None:
        """Let a wait end, from another thread."""
        self._ended.set()


class PlainGuide:
    """A person at a terminal. `back` leaves a step, `quit` or the end of the input ends the session."""

    def __init__(self, pictures: Path, read: Callable[[], str | None] | None = None, descriptor: int = 0) -> None:
        """Pictures are written into the folder `pictures` and named; lines come from `read`, else from `descriptor`."""
        self._pictures = pictures
        self._lines = Lines(descriptor)
        self._read = read or self._lines.read
        self._shown = 0

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        """Print one line per step."""
        say("", f"`{BACK}` leaves a step, `{QUIT}` ends the session, ctrl-c stops the arm; what was taught is kept.")
        for number, step in enumerate(steps, start=1):
            after = f": {step.summary}" if step.summary else f" (about {step.minutes} min)"
            say(f"{MARKS[step.state]} {number}. {step.title}{after}")

    async def show(self, what: Shown) -> None:
        """Print the lines; write a picture into the folder and print its path."""
        head = {"finding": "", "warning": "warning: ", "trouble": "TROUBLE: ", "progress": "... "}[what.tone]
        for number, line in enumerate(what.lines):
            say(f"  {head if number == 0 else ''}{line}")
        if what.picture is not None:
            say(f"  picture: {await asyncio.to_thread(self._save, what)}")

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
        """Print the choices and read a key."""
        keys = {choice.key: choice for choice in choices}
        say(question, *(f"  {c.key}: {c.label}{' (Enter)' if c.key == default else ''}" for c in choices))
        while True:
            answer = await self._line() or default
            if answer in keys:
                return answer
            say(f"  {answer!r} is not one of {', '.join(keys)}")

    async def number(self, question: str, unit: str, low: float, high: float, default: float | None) -> float:
        """Read a number in the range."""
        ending = "" if default is None else f"; Enter: {default:g}"
        say(f"{question} [{unit}, {low:g} to {high:g}{ending}]")
        while True:
            answer = await self._line()
            if not answer and default is not None:
                return default
            try:
                return number_in(answer, unit, low, high)
            except ValueError as error:
                say(f"  {error}")

    async def text(self, question: str, default: str) -> str:
        """Read a line."""
        say(f"{question}{f' [Enter: {default}]' if default else ''}")
        return await self._line() or default

    async def bring(self, target: Target, how: str) -> Brought:
        """Print the request and wait for Enter."""
        words = (*((JOG,) if target.may_jog else ()), *((SKIP,) if target.may_skip else ()), BACK)
        say(how, f"  Enter: it is there; {'; '.join(words)}")
        while True:
            match (await self._raw()).strip().lower():
                case "":
                    return Brought.DONE
                case "skip" if target.may_skip:
                    return Brought.SKIP
                case "back":
                    return Brought.BACK
                case "jog" if target.may_jog:
                    return Brought.JOG
                case other:
                    say(f"  {other!r} is not one of Enter, {', '.join(words)}")

    async def jog(self, view: JogView) -> JogStep | Brought:
        """Read a step such as `z -0.1`."""
        moved = ", ".join(f"{v:+.2f}" for v in view.moved_mm)
        if view.refused:
            say(f"  {view.refused}")
        steps = ", ".join(f"{s:g}" for s in view.steps_mm)
        say(f"{view.question} Moved by ({moved}) mm.", f"  `z -0.1` (steps {steps} mm); Enter: it is there; {BACK}")
        while True:
            words = (await self._raw()).strip().lower().split()
            match words:
                case []:
                    return Brought.DONE
                case ["back"]:
                    return Brought.BACK
                case ["x" | "y" | "z" as axis, mm] if _is_step(mm, view.steps_mm):
                    return JogStep(axis, float(mm))
                case _:
                    say(f"  {' '.join(words)!r} is not a step such as `z -0.1`")

    async def _line(self) -> str:
        answer = (await self._raw()).strip()
        if answer.lower() == BACK:
            raise WentBack
        return answer

    async def _raw(self) -> str:
        try:
            line = await asyncio.to_thread(self._read)
        except asyncio.CancelledError:
            self._lines.end()
            raise
        if line is None or line.strip().lower() == QUIT:
            raise LeftOff
        return line

    def _save(self, what: Shown) -> Path:
        import cv2

        assert what.picture is not None
        self._pictures.mkdir(parents=True, exist_ok=True)
        self._shown += 1
        path = self._pictures / f"{self._shown:02d}.png"
        cv2.imwrite(str(path), what.picture)
        return path


def _is_step(text: str, steps_mm: tuple[float, ...]) -> bool:
    try:
        value = abs(float(text))
    except ValueError:
        return False
    return any(abs(value - step) < 1e-9 for step in steps_mm)
