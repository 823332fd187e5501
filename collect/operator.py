"""Questions that a run asks its operator, and what the operator asks of a run by key or signal."""

from __future__ import annotations

import asyncio
import contextlib
import signal
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import FrameType
from typing import TYPE_CHECKING, Any

from brushloop.collect.errors import NeedsOperator

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Choice:
    """One answer to a question."""

    key: str
    """Key on the keyboard."""
    label: str
    """What the answer means."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """A question to a person, answered by a key or by a typed line; it waits until it is answered."""

    question: str
    choices: tuple[Choice, ...] = ()
    """A line for each key that answers it."""
    default: str = ""
    """Answer that moves nothing, which holds if nobody can answer; on the first day, what Enter stands for."""
    image: NDArray[np.uint8] | None = field(default=None, compare=False)
    """Gray picture of what the question is about."""
    number: int = 0
    """Number of the question in its run, from 1; set by `Asker.ask`."""
    answers: Mapping[str, object] = field(default_factory=dict[str, object])
    """What keys stand for, if not for themselves: `enter`, `left`, `j`."""
    read: Callable[[str], object] | None = None
    """Reads a typed line; raises ValueError, worded for the person. None where the answer is a key."""
    allowed: str = ""
    """What a typed line may be, or what more keys do."""
    thing: str = ""
    """What the person brings somewhere, such as `pin 3`; empty where nothing is moved by hand."""

    def answer_to(self, *keys: str) -> object | None:
        """What the first of these keys answers that answers anything."""
        answers = {choice.key: choice.key for choice in self.choices} | dict(self.answers)
        return next((answers[key] for key in keys if key in answers), None)


class Asker:
    """Passes one question at a time from an event loop to a screen, and the answer back. Only `ask` is of the loop."""

    def __init__(
        self, *, watched: bool, waiting: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
    ) -> None:
        """`waiting` is entered while a question waits for its answer."""
        self._waiting = waiting
        self._given_up: Callable[[str], Exception] | None = None if watched else NeedsOperator
        self._lock = threading.Lock()
        self._count = 0
        self._open: tuple[Prompt, asyncio.AbstractEventLoop, asyncio.Future[Any]] | None = None

    @property
    def watched(self) -> bool:
        """Whether somebody watches a screen that can answer."""
        return self._given_up is None

    @property
    def prompt(self) -> Prompt | None:
        """The question that waits for an answer."""
        with self._lock:
            return None if self._open is None else self._open[0]

    def abandon(self, error: Callable[[str], Exception] = NeedsOperator) -> None:
        """Fail the open question and every later one with this error: nobody is watching now."""
        with self._lock:
            self._given_up = error
        if (prompt := self.prompt) is not None:
            self.settle(prompt.number, error("nobody is at the screen now"))

    async def ask(self, prompt: Prompt) -> Any:
        """The key of the answer, or what stands for it. Raises `NeedsOperator`, or what `abandon` says, if nobody can
        answer, and the exception that it is settled with."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[Any] = loop.create_future()
        with self._waiting():
            with self._lock:
                if self._given_up is not None:
                    raise self._given_up(prompt.question)
                self._count += 1
                self._open = (replace(prompt, number=self._count), loop, answered)
            try:
                return await answered
            finally:
                with self._lock:
                    self._open = None

    async def ask_or_default(self, prompt: Prompt) -> str:
        """Return the key of the answer, or that of the default if nobody can answer."""
        try:
            return await self.ask(prompt)
        except NeedsOperator:
            return prompt.default

    def answer(self, number: int, key: str) -> bool:
        """Answer question `number` by key; False if it is closed or has no such choice."""
        prompt = self.prompt
        answer = None if prompt is None else prompt.answer_to(key)
        return answer is not None and self.settle(number, answer)

    def settle(self, number: int, answer: object) -> bool:
        """Answer question `number`, with an exception to raise there; False if it is closed."""

        def settle() -> None:
            if not answered.done():
                answered.set_exception(answer) if isinstance(answer, Exception) else answered.set_result(answer)

        with self._lock:
            if self._open is None or self._open[0].number != number:
                return False
            _, loop, answered = self._open
            loop.call_soon_threadsafe(settle)
            return True


class OperatorRequest(StrEnum):
    """Request that an operator can make by key; the same key again withdraws it. The value names the key."""

    RETAKE = "retake"
    """Press this stroke again."""
    SKIP = "skip"
    """Leave this stroke out."""
    NEW_SHEET = "new sheet"
    JOG = "jog"
    """Find the paper again by jog."""


EXCLUSIVE = {OperatorRequest.RETAKE, OperatorRequest.SKIP}
"""Of these, only the last that was made counts."""


STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def stop_signals(handle: Callable[[int], object]) -> Generator[None]:
    """Within the block, call `handle` with the number of each of `STOP_SIGNALS`, in a separate thread."""

    def on_signal(number: int, _frame: FrameType | None) -> None:
        # Not from the handler itself: it may have interrupted code that holds the engine's lock.
        threading.Thread(target=handle, args=(number,), name="stop key").start()

    before = {number: signal.signal(number, on_signal) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
