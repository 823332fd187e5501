"""The guided first day between two threads: the steps ask in theirs, the screen answers from its own."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, Literal

from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.teach.guide import (
    Answer,
    Brought,
    JogStep,
    JogView,
    Picture,
    Question,
    Shown,
    StepState,
    number_in,
)
from brushloop.drivers.devices import Pose

MOST_FINDINGS = 200
"""Findings that can be scrolled back to."""
JOG_KEYS: Mapping[str, tuple[Literal["x", "y", "z"], float]] = {
    "left": ("x", -1.0),
    "right": ("x", 1.0),
    "down": ("y", -1.0),
    "up": ("y", 1.0),
    "pagedown": ("z", -1.0),
    "pageup": ("z", 1.0),
}
THERE = Choice("enter", "it is there")
BY_KEYS = Choice("j", "bring the tip the last millimetres by keys")
SKIP = Choice("k", "skip it")


class ScreenGuide:
    """`Guide` for a screen, which reads its fields. What a step awaits runs in the steps' loop, all else anywhere."""

    def __init__(self, findings: tuple[Shown, ...] = ()) -> None:
        """`findings` are those of an earlier run, which was stopped."""
        self.asker = Asker(watched=True)
        self.steps: tuple[StepState, ...] = ()
        self.findings = findings
        self.picture: Picture | None = None
        """The newest picture of a finding."""
        self.tip: Pose | None = None
        """Where the tip is now, or the flange before the tip is taught."""
        self.tip_known = False
        self.live: Picture | None = None
        """What the camera sees now, where that is known."""
        self.question: Question | None = None
        self.doing: tuple[str, float] = ("", time.monotonic())
        """What is at work while nothing is asked, empty where no step has said so, and since when."""
        self._size = 0
        """Index of the size of a step by jog."""

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        """Show the steps and their states."""
        self.steps = steps

    async def show(self, what: Shown) -> None:
        """Add a finding, and show its picture if it has one; progress is shown until there is something newer."""
        if what.tone == "progress":
            self.doing = " ".join(what.lines), time.monotonic()
            return
        self.findings = (*self.findings, what)[-MOST_FINDINGS:]
        self.picture = self.picture if what.picture is None else what.picture

    async def ask(self, question: Question) -> Answer:
        """Wait for the answer. While the tip is jogged, digits choose the size of the steps, and nothing else."""
        self.question = question
        try:
            while isinstance(answer := await self.asker.ask(self._prompt(question)), int):
                self._size = answer - 1
            return answer
        finally:
            self.question, self.doing = None, ("", time.monotonic())

    def _prompt(self, question: Question) -> Prompt:
        text, default = question.text, question.default
        match question.kind:
            case "choose":
                return Prompt(text, question.choices, default, answers={"enter": default} if default else {})
            case "text":
                return Prompt(text, default=default, read=str)
            case "number":

                def read(line: str) -> float:
                    return number_in(line, question.unit, question.low, question.high)

                allowed = f"{question.low:g} to {question.high:g} {question.unit}"
                return Prompt(text, default=default, read=read, allowed=allowed)
            case "bring":
                answers = {"enter": Brought.DONE}
                answers |= {"j": Brought.JOG} if question.may_jog else {}
                answers |= {"k": Brought.SKIP} if question.may_skip else {}
                choices = tuple(choice for choice in (THERE, BY_KEYS, SKIP) if choice.key in answers)
                return Prompt(text, choices, answers=answers)
            case "jog":
                assert question.jog is not None
                return self._jog_prompt(text, question.jog)

    def _jog_prompt(self, text: str, view: JogView) -> Prompt:
        chosen_mm = view.steps_mm[min(self._size, len(view.steps_mm) - 1)]
        answers: dict[str, object] = {"enter": Brought.DONE}
        answers |= {str(n): n for n in range(1, len(view.steps_mm) + 1)}
        answers |= {key: JogStep(axis, sign * chosen_mm) for key, (axis, sign) in JOG_KEYS.items()}
        sizes = (f"{'›' if mm == chosen_mm else ' '}{n}: {mm:g} mm" for n, mm in enumerate(view.steps_mm, 1))
        lines = [
            f"moved by ({', '.join(f'{v:+.2f}' for v in view.moved_mm)}) mm, base x y z",
            f"step  {'  '.join(sizes)}",
            "arrows: x y   page up, page down: z   enter: it is there",
            *([f"! {view.refused}"] if view.refused else []),
        ]
        return Prompt(text, answers=answers, allowed="\n".join(lines))

    def see_pose(self, tip: Pose | None, tip_known: bool) -> None:
        """Show where the arm is."""
        self.tip, self.tip_known = tip, tip_known

    @property
    def looking(self) -> bool:
        """Whether the person guides something by hand, and wants to see it."""
        return self.question is not None and self.question.kind in ("bring", "jog")

    def see_picture(self, picture: Picture | None) -> None:
        """Show what the camera sees."""
        self.live = picture


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
