"""Questions that a run asks its operator, and requests that the operator makes by key."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING

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
    """A question to the operator; it waits until it is answered."""

    question: str
    choices: tuple[Choice, ...]
    default: str
    """Key of the answer that moves nothing: it holds if nobody can answer, and for an empty line in the first day."""
    image: NDArray[np.uint8] | None = field(default=None, compare=False)
    """Gray picture of what the question is about."""
    number: int = 0
    """Number of the question in its run, from 1; set by `Asker.ask`."""


class Asker:
    """Passes one question at a time from the engine's event loop to a screen, and the answer back."""

    def __init__(
        self, *, watched: bool, waiting: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext
    ) -> None:
        """`waiting` is entered while a question waits for its answer."""
        self.attended = watched
        """Whether the run was begun with somebody who watches; the screen may be gone since."""
        self._waiting = waiting
        self._watched = watched
        self._lock = threading.Lock()
        self._count = 0
        self._open: tuple[Prompt, asyncio.AbstractEventLoop, asyncio.Future[str]] | None = None

    @property
    def watched(self) -> bool:
        """Whether somebody watches a screen that can answer."""
        return self._watched

    @property
    def prompt(self) -> Prompt | None:
        """The question that waits for an answer; from any thread."""
        with self._lock:
            return None if self._open is None else self._open[0]

    def abandon(self) -> None:
        """Fail the open question and every later one with `NeedsOperator`: nobody is watching now. From any thread."""
        with self._lock:
            self._watched = False
            if self._open is not None:
                _, loop, answered = self._open
                loop.call_soon_threadsafe(_give_up, answered)

    async def ask(self, prompt: Prompt) -> str:
        """Return the key of the answer. Raises `NeedsOperator` if nobody can answer."""
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[str] = loop.create_future()
        with self._waiting():
            with self._lock:
                if not self._watched:
                    raise NeedsOperator(prompt.question)
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
        """Answer question `number`; False if it is closed or has no such choice. From any thread."""
        with self._lock:
            if self._open is None or self._open[0].number != number:
                return False
            prompt, loop, answered = self._open
            if key not in {choice.key for choice in prompt.choices}:
                return False
            loop.call_soon_threadsafe(_settle, answered, key)
            return True


def _give_up(answered: asyncio.Future[str]) -> None:
    if not answered.done():
        answered.set_exception(NeedsOperator("nobody is at the screen now"))


def _settle(answered: asyncio.Future[str], key: str) -> None:
    if not answered.done():
        answered.set_result(key)


class OperatorRequest(StrEnum):
    """Request that an operator can make by key; the same key again withdraws it."""

    RETAKE = "press this stroke again"
    SKIP = "leave this stroke out"
    NEW_SHEET = "put a new sheet in"
    JOG = "find the paper again by jog"

    @property
    def short(self) -> str:
        """The name of its key."""
        return self.name.lower().replace("_", " ")


class OperatorRequests:
    """Requests that wait until they can be carried out. Any thread may make them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[OperatorRequest] = set()

    @property
    def open(self) -> tuple[OperatorRequest, ...]:
        """Requests that are still pending."""
        with self._lock:
            return tuple(request for request in OperatorRequest if request in self._open)

    def toggle(self, request: OperatorRequest) -> bool:
        """Make or withdraw a request; True if it is now pending. Retake and skip exclude each other."""
        with self._lock:
            if request in self._open:
                self._open.remove(request)
                return False
            if request in (OperatorRequest.RETAKE, OperatorRequest.SKIP):
                self._open -= {OperatorRequest.RETAKE, OperatorRequest.SKIP}
            self._open.add(request)
            return True

    def take(self, request: OperatorRequest) -> bool:
        """Remove a request that is about to be carried out; False if it was not made."""
        with self._lock:
            if request not in self._open:
                return False
            self._open.remove(request)
            return True
