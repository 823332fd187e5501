"""Questions to the operator: the engine asks and waits, a screen shows and answers; unwatched, nobody answers."""

from __future__ import annotations

import asyncio
import threading
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from collect.errors import NeedsOperator

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Choice:
    """One answer: its key on the keyboard, and what it means."""

    key: str
    label: str


@dataclass(frozen=True, slots=True)
class Prompt:
    """A question, with the picture that caused it and what happens if nobody answers."""

    question: str
    choices: tuple[Choice, ...]
    default: str
    """The key that is taken when the time is over."""
    timeout_s: float | None = None
    """None waits for ever."""
    image: NDArray[np.uint8] | None = field(default=None, compare=False)
    number: int = 0
    asked_s: float = 0.0
    """By `time.monotonic`: a clock that is set must not change how long the default waits."""


class Asker:
    """Hands one prompt at a time from the engine's loop to a screen, and its answer back."""

    def __init__(self, *, watched: bool) -> None:
        self._watched = watched
        self._lock = threading.Lock()
        self._count = 0
        self._open: tuple[Prompt, asyncio.AbstractEventLoop, asyncio.Future[str]] | None = None

    @property
    def watched(self) -> bool:
        """Whether somebody looks at a screen that can answer."""
        return self._watched

    @property
    def prompt(self) -> Prompt | None:
        """What waits for an answer; from any thread."""
        with self._lock:
            return None if self._open is None else self._open[0]

    def abandon(self) -> None:
        """Nobody looks any more: what is asked, and whatever will be, raises `NeedsOperator`. From any thread."""
        with self._lock:
            self._watched = False
            if self._open is not None:
                _, loop, answered = self._open
                loop.call_soon_threadsafe(_give_up, answered)

    async def ask(self, prompt: Prompt) -> str:
        """The key of the answer. Raises `NeedsOperator` where nobody is there to answer."""
        if not self._watched:
            raise NeedsOperator(prompt.question)
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[str] = loop.create_future()
        with self._lock:
            self._count += 1
            asked = replace(prompt, number=self._count, asked_s=time.monotonic())
            self._open = (asked, loop, answered)
        try:
            async with asyncio.timeout(prompt.timeout_s):
                return await answered
        except TimeoutError:
            return prompt.default
        finally:
            with self._lock:
                self._open = None

    def answer(self, number: int, key: str) -> bool:
        """Answer the prompt of that number; False where it is over or has no such choice. From any thread."""
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
        answered.set_exception(NeedsOperator("nobody is at the screen any more"))


def _settle(answered: asyncio.Future[str], key: str) -> None:
    if not answered.done():
        answered.set_result(key)
