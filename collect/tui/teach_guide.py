"""The guided first day between two threads: the steps ask in theirs, the screen answers from its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from brushloop.collect.errors import CollectAborted
from brushloop.collect.teach.guide import Answer, LeftOff, Picture, Question, Shown, StepState, WentBack
from brushloop.drivers.devices import Pose

MOST_FINDINGS = 200
"""Findings that can be scrolled back to."""


@dataclass(frozen=True, slots=True)
class TeachView:
    """Everything that the screen shows; replaced whole, so that any thread may read it."""

    steps: tuple[StepState, ...] = ()
    findings: tuple[Shown, ...] = ()
    question: Question | None = None
    picture: Picture | None = None
    """The newest picture of a finding."""
    tip: Pose | None = None
    """Where the tip is now, or the flange before the tip is taught."""
    tip_known: bool = False
    live: Picture | None = None
    """What the camera sees now, where that is known."""
    doing: str = ""
    """What is at work while nothing is asked; empty where no step has said so."""
    doing_since_s: float = 0.0
    """Since when, by `time.monotonic`."""


class ScreenGuide:
    """`Guide` for a screen. The methods that a step awaits run in the steps' event loop, all others in any thread."""

    def __init__(self, findings: tuple[Shown, ...] = ()) -> None:
        """`findings` are those of an earlier run, which was stopped."""
        self._lock = threading.Lock()
        self._view = TeachView(findings=findings, doing_since_s=time.monotonic())
        self._count = 0
        self._open: tuple[asyncio.AbstractEventLoop, asyncio.Future[Answer]] | None = None
        self._leaving = False

    @property
    def view(self) -> TeachView:
        """What the screen should show now."""
        with self._lock:
            return self._view

    # Of the steps

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        """Show the steps and their states."""
        self._change(steps=steps)

    async def show(self, what: Shown) -> None:
        """Add a finding, and show its picture if it has one; progress is shown until there is something newer."""
        if what.tone == "progress":
            self._change(doing=" ".join(what.lines), doing_since_s=time.monotonic())
            return
        findings = (*self.view.findings, what)[-MOST_FINDINGS:]
        self._change(findings=findings, picture=self.view.picture if what.picture is None else what.picture)

    async def ask(self, question: Question) -> Answer:
        """Show the question and wait for the answer; the screen takes only one that the question allows."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Answer] = loop.create_future()
        with self._lock:
            if self._leaving:
                raise LeftOff
            self._count += 1
            self._open = (loop, future)
            self._view = replace(self._view, question=replace(question, number=self._count))
        try:
            return await future
        finally:
            with self._lock:
                self._open = None
                self._view = replace(self._view, question=None, doing="", doing_since_s=time.monotonic())

    def see_pose(self, tip: Pose | None, tip_known: bool) -> None:
        """Show where the arm is."""
        self._change(tip=tip, tip_known=tip_known)

    def see_picture(self, picture: Picture | None) -> None:
        """Show what the camera sees."""
        self._change(live=picture)

    @property
    def looking(self) -> bool:
        """Whether the person guides something by hand, and wants to see it."""
        question = self.view.question
        return question is not None and question.kind in ("bring", "jog")

    # Of the screen

    def answer(self, number: int, answer: Answer) -> None:
        """Answer the question of that number; nothing happens if it is answered already."""
        self._settle(number, lambda future: future.set_result(answer))

    def back(self, number: int) -> None:
        """Go back to the question before."""
        self._settle(number, lambda future: future.set_exception(WentBack()))

    def leave(self) -> None:
        """End at the open question, or at the next one."""
        with self._lock:
            self._leaving, question = True, self._view.question
        if question is not None:
            self._settle(question.number, lambda future: future.set_exception(LeftOff()))

    def _settle(self, number: int, settle: Callable[[asyncio.Future[Answer]], None]) -> None:
        with self._lock:
            if self._open is None or self._view.question is None or self._view.question.number != number:
                return
            loop, future = self._open
            self._open = None
        loop.call_soon_threadsafe(lambda: None if future.done() else settle(future))

    def _change(self, **fields: Any) -> None:
        with self._lock:
            self._view = replace(self._view, **fields)


class Teaching:
    """The steps in a thread of their own, so that nothing they compute keeps a stop waiting on the screen."""

    def __init__(
        self, work: Callable[[ScreenGuide], Coroutine[Any, Any, Path | None]], findings: tuple[Shown, ...] = ()
    ) -> None:
        self.guide = ScreenGuide(findings)
        self.error: BaseException | None = None
        """What ended it, other than a stop."""
        self.written: Path | None = None
        """What the steps returned: the `rig.toml` that they wrote, if they did."""
        self.stopped = False
        """Whether a stop ended it."""
        self._work = work
        self._stop_sent = False
        self._started = threading.Event()
        self._task: asyncio.Task[Path | None] | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, name="first day", daemon=True)

    def start(self) -> None:
        """Begin; returns once a stop can be carried out."""
        self._thread.start()
        self._started.wait()

    @property
    def finished(self) -> bool:
        """Whether it is over."""
        return self._started.is_set() and not self._thread.is_alive()

    def stop(self) -> None:
        """Cancel what is under way: a driver stops its arm before it lets a cancelled move end. From any thread."""
        if self._loop is not None and self._task is not None:
            self._stop_sent = True
            with contextlib.suppress(RuntimeError):  # the loop has just ended
                self._loop.call_soon_threadsafe(self._task.cancel)

    def join(self) -> None:
        """Wait for the end, and raise what ended it."""
        self._thread.join()
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        try:
            asyncio.run(self._main())
        except asyncio.CancelledError as stopped:
            self.stopped = True
            # The notes say whether the arm was seen at rest.
            if notes := getattr(stopped, "__notes__", []):
                self.error = StopUnsure(" ".join(notes))
        except CollectAborted as error:
            # A run within the steps has its own word for the stop that it was sent.
            self.stopped = self._stop_sent
            self.error = None if self.stopped else error
        except BaseException as error:
            self.error = error
        finally:
            self._started.set()

    async def _main(self) -> None:
        self._loop, self._task = asyncio.get_running_loop(), asyncio.ensure_future(self._work(self.guide))
        self._started.set()
        self.written = await self._task


class StopUnsure(Exception):
    """The arm was asked to stop and was not seen at rest."""

    exit_code = 4

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} Use the emergency stop, the red button, if it moves.")
