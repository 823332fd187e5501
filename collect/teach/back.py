"""Going back one question: what a person answered last is taken back, and asked again."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import TypeVar

from brushloop.collect.operator import Choice
from brushloop.collect.teach.guide import Brought, Guide, JogStep, JogView, Shown, StepState, Target
from brushloop.collect.teach.store import Notebook

Answer = str | float | Brought
AnyAnswer = TypeVar("AnyAnswer", str, float, Brought)


@dataclass(frozen=True, slots=True)
class Answered:
    """One answer, and the notebook as it was when its question was asked."""

    notebook: Notebook
    question: tuple[object, ...]
    """With what could be answered."""
    answer: Answer


class BackGuide:
    """Passes everything on to a person, and remembers the answers of this process.

    A step asks nothing that is in the notebook. So the notebook as it was at a question leads a step back to it, with
    the answers before it that were not yet kept. These are given again by themselves only where nothing was done in
    between: an answer of before never moves the arm, doses ink or reads a pose.
    """

    def __init__(self, person: Guide, notebook: Callable[[], Notebook]) -> None:
        self._person = person
        self._notebook = notebook
        self._answered: list[Answered] = []
        self._settled = 0
        """Number of answers that are never given again by themselves."""
        self._repeated: list[Answered] = []
        """Answers that are given by themselves next."""

    def take_back(self) -> Notebook | None:
        """Forget the last answer; returns the notebook that leads back to its question, None if there was none."""
        if not self._answered:
            return None
        last = self._answered.pop()
        first = len(self._answered)
        while first and self._answered[first - 1].notebook is last.notebook:
            first -= 1
        self._repeated = self._answered[max(first, self._settled) :]
        del self._answered[first:]
        self._settled = min(self._settled, first)
        return last.notebook

    def settle(self) -> None:
        """Give no answer of before again by itself: something was done, or the step is begun again."""
        self._settled, self._repeated = len(self._answered), []

    def mark(self) -> None:
        """Let going back lead to the notebook of now."""
        self._answered.append(Answered(self._notebook(), (), ""))
        self.settle()

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        """Show the steps."""
        await self._person.overview(steps)

    async def show(self, what: Shown) -> None:
        """Show a finding."""
        await self._person.show(what)

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
        """The key of one of the choices."""
        return await self._asked((question, choices), lambda: self._person.choose(question, choices, default))

    async def number(self, question: str, unit: str, low: float, high: float, default: float | None) -> float:
        """A number in [low, high]."""
        asked = (question, unit, low, high)
        return await self._asked(asked, lambda: self._person.number(question, unit, low, high, default))

    async def text(self, question: str, default: str) -> str:
        """A line of text."""
        return await self._asked((question,), lambda: self._person.text(question, default))

    async def bring(self, target: Target, how: str) -> Brought:
        """Wait until the person says that the tip is there."""
        brought = await self._asked((how, target), lambda: self._person.bring(target, how))
        if brought is not Brought.SKIP:
            self.settle()
        return brought

    async def jog(self, view: JogView) -> JogStep | Brought:
        """The next step by key; a jog is taken back with the place to which it led."""
        return await self._person.jog(view)

    async def _asked(self, question: tuple[object, ...], ask: Callable[[], Awaitable[AnyAnswer]]) -> AnyAnswer:
        notebook = self._notebook()
        if self._repeated and self._repeated[0].question == question:
            answer: AnyAnswer = self._repeated.pop(0).answer  # pyright: ignore[reportAssignmentType]  # the same question
        else:
            self._repeated = []
            answer = await ask()
        self._answered.append(Answered(notebook, question, answer))
        return answer
