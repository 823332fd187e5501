"""Runs of an engine as a test drives them, step by step in simulated time, and waits that end."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import pytest

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.open_or_resume import Opening
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.operator import Prompt
from tests.simulated_time import MemoryLoop, SimulatedTime

PATIENCE_S = 600.0
"""Simulated time that a test waits for anything."""

_R = TypeVar("_R")
_E = TypeVar("_E", bound=Exception)


class SteppedEngine(Engine):
    """An engine in the test's own thread. Its run goes on while the test waits for it, and stands still from the moment
    at which what the test waits for is so."""

    def __init__(self, opening: Opening, resumes: Path | None, clock: SimulatedTime) -> None:
        super().__init__(opening, resumes, clock)
        self._time = clock
        self._runner = asyncio.Runner(loop_factory=lambda: MemoryLoop(clock, self._stands_still))
        self._whole: asyncio.Task[None] | None = None
        self._met: Callable[[], bool] = lambda: False
        self._until_s = 0.0

    def start(self) -> None:
        loop = self._runner.get_loop()
        self._whole = loop.create_task(self._main())
        self._whole.add_done_callback(lambda _: loop.stop())

    def join(self) -> None:
        self._outcome.result()

    def wait_until(self, met: Callable[[], bool]) -> bool:
        """Let the run go on until the condition is met, or the run is over.

        False where neither is so after `PATIENCE_S`. Raises what the condition raises.
        """
        if self._whole is not None and not self.finished:
            self._met, self._until_s = met, self._time.now_s + PATIENCE_S
            self._runner.get_loop().run_forever()
            if not self._whole.done():
                return self._time.now_s <= self._until_s
            self._runner.close()
            if (error := self._whole.exception()) is None:
                self._outcome.set_result(None)
            else:
                self._outcome.set_exception(error)
        return True

    def _stands_still(self) -> bool:
        if self._met() or self._time.now_s > self._until_s:
            self._runner.get_loop().stop()
            return True
        return False

    def meanwhile(self, work: Coroutine[Any, Any, _R]) -> _R:
        """Do this in the loop of the run, as somebody else beside it, while the run goes on."""
        doing = self._runner.get_loop().create_task(work)
        self.wait_until(doing.done)
        return doing.result()


def until(engine: SteppedEngine, condition: Callable[[Snapshot], bool]) -> Snapshot:
    """The first snapshot that meets the condition; fails where it does not come in time, or the run is over."""
    met: list[Snapshot] = []

    def looked() -> bool:
        now = engine.snapshot()
        met.extend([now] if condition(now) else [])
        return bool(met)

    in_time = engine.wait_until(looked)
    if not met:
        why = "the run ended" if engine.finished else "the run went on" if in_time else "time ran out"
        pytest.fail(f"{why} while a test waited for {_source(condition)}: {engine.snapshot()}")
    return met[0]


def wait_for_end(engine: SteppedEngine) -> None:
    """Wait until the run is over, and raise what ended it; stops the run and fails where it does not end in time."""
    if not engine.wait_until(lambda: False):
        now = engine.snapshot()
        end(engine)
        pytest.fail(f"a test waited in vain for the end of the run; it is: {now}")
    engine.join()


def ended_by(engine: SteppedEngine, error: type[_E], says: str | None = None) -> _E:
    """The error that ends the run, which must be of this kind and hold these words (a pattern)."""
    with pytest.raises(error, match=says) as caught:
        wait_for_end(engine)
    return caught.value


def question(engine: SteppedEngine, words: str = "", after: int = 0) -> Prompt:
    """The next open question that holds these words, and comes after the one of that number."""

    def is_asked(prompt: Prompt | None) -> bool:
        return prompt is not None and prompt.number > after and words in prompt.question

    prompt = until(engine, lambda now: is_asked(now.prompt)).prompt
    assert prompt is not None
    return prompt


def answer(engine: SteppedEngine, words: str, key: str) -> None:
    """Answer the next question that holds these words."""
    number = question(engine, words).number
    assert engine.answer(number, key)
    until(engine, lambda now: now.prompt is None or now.prompt.number != number)


def answered_alike(engine: SteppedEngine, key: str) -> list[str]:
    """Run to the end, answering every question the same way; the questions. Raises what ended the run."""
    questions: dict[int, str] = {}

    def answering() -> bool:
        prompt = engine.snapshot().prompt
        if prompt is not None and prompt.number not in questions:
            questions[prompt.number] = prompt.question
            assert engine.answer(prompt.number, key)
        return False

    engine.start()
    engine.wait_until(answering)
    wait_for_end(engine)
    return list(questions.values())


def end(engine: SteppedEngine) -> None:
    """Stop a run that a test has left."""
    if not engine.finished:
        engine.stop()
    engine.wait_until(lambda: False)


def _source(condition: Callable[[Snapshot], bool]) -> str:
    try:
        return inspect.getsource(condition).strip()
    except OSError:
        return repr(condition)
