"""What every step works with: the person, the notebook, and what it may do."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from brushloop.collect.errors import CannotTeach, StepError
from brushloop.collect.operator import Choice
from brushloop.collect.rig.check import Check
from brushloop.collect.teach.guide import Answer, Guide, Picture, Question, Shown, Tone
from brushloop.collect.teach.store import Notebook, StepName, Taught, TaughtFile, Value, taught
from brushloop.drivers.host import Clock

ARM = Choice("a", "let it move: I look at the cell, my hand is at the emergency stop")
STAY = Choice("x", "leave it where it is")
YES, NO = Choice("y", "yes"), Choice("n", "no")


@dataclass(frozen=True, slots=True)
class Asked:
    """One value that a person types or chooses: its field in `rig.toml`, the question, its range, and its check."""

    field: str
    question: str
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    """Range of a number; a text or a choice has none."""
    how: str = "typed"
    sigma: float | None = None
    default: str | Callable[[Notebook], str] = ""
    """What an empty line stands for; an empty text if it is no answer."""
    choices: tuple[Choice, ...] = ()
    check: Callable[[Notebook, float], Check] | None = None
    """Compares the number with what is known already."""
    whole: bool = False
    """Whether it is a whole number."""


class Day:
    """One session with a person at one rig. Everything that is kept is on disk when the method returns."""

    def __init__(self, guide: Guide, rig_path: Path, clock: Clock, *, armed: bool) -> None:
        """`armed`: the command line allows motion; the person is asked again each time. Raises `ConfigError`."""
        self.guide = guide
        self.rig_path = rig_path
        self.clock = clock
        self.armed = armed
        self._held = False
        self._file = TaughtFile(rig_path)
        self.notebook: Notebook = self._file.load()
        self._answered: list[Notebook] = []
        """The notebook as it was at each question of this process that was answered."""

    # The notebook

    def save(self, notebook: Notebook) -> None:
        """Replace the notebook."""
        if not self._held:
            self._file.save(notebook)
        self.notebook = notebook

    def keep(
        self,
        step: StepName,
        field: str,
        value: Value,
        how: str,
        unit: str = "",
        *,
        sigma: float | None = None,
        known: str = "",
    ) -> None:
        """Note one value."""
        self.save(self.notebook.with_values({field: taught(step, value, how, unit, sigma=sigma, known=known)}))

    @contextlib.contextmanager
    def together(self) -> Generator[None]:
        """Values kept in the block are on disk together at its end: all of them are known, or none."""
        before, self._held = self.notebook, True
        try:
            yield
        except BaseException:
            self.notebook = before
            raise
        finally:
            self._held = False
        self.save(self.notebook)

    @contextlib.contextmanager
    def touched_again_if_refused(self, *kinds: str) -> Generator[None]:
        """Forget the touches of these kinds because they contradict each other; they are asked for again."""
        try:
            yield
        except (CannotTeach, StepError):
            self.save(self.notebook.without(*kinds))
            raise

    # The person

    async def say(self, *lines: str, tone: Tone = "finding", picture: Picture | None = None) -> None:
        """Show lines to the person."""
        await self.guide.show(Shown(lines, picture, tone))

    async def working(self, what: str) -> None:
        """Show what is being done until the next finding or question."""
        await self.say(what, tone="progress")

    async def ask(self, question: Question) -> Answer:
        """Ask, and let going back lead here.

        A step asks nothing that is in the notebook, so the notebook of now leads it to this question again; answers
        that were not kept are one with those before them.
        """
        notebook = self.notebook
        answer = await self.guide.ask(question)
        if not self._answered or self._answered[-1] is not notebook:
            self._answered.append(notebook)
        return answer

    def mark(self) -> None:
        """Let going back lead to the notebook of now."""
        self._answered.append(self.notebook)

    def back(self) -> bool:
        """Restore the notebook of the last answered question, so that it is asked again; False if there is none."""
        if not self._answered:
            return False
        self.save(self._answered.pop())
        return True

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str = "") -> str:
        """The key of one of the choices; `default` is taken for an empty answer, which is none if it is empty."""
        return str(await self.ask(Question("choose", question, choices, default)))

    async def yes(self, question: str) -> bool:
        """Ask for yes or no; Enter is neither."""
        return await self.choose(question, (YES, NO)) == YES.key

    async def text(self, question: str, default: str = "") -> str:
        """A line of text; `default` is taken for an empty answer."""
        return str(await self.ask(Question("text", question, default=default))).strip()

    async def values(self, step: StepName, *values: Asked) -> None:
        """Ask for each of these values that is not known yet, check it, and keep it. Raises `CannotTeach`."""
        for asked in values:
            if asked.field in self.notebook.values:
                continue
            default = asked.default if isinstance(asked.default, str) else asked.default(self.notebook)
            kind = "choose" if asked.choices else "number" if asked.high > asked.low else "text"
            question = Question(
                kind, asked.question, asked.choices, default, unit=asked.unit, low=asked.low, high=asked.high
            )
            answer = await self.ask(question)
            how = asked.how
            if isinstance(answer, float):
                if asked.check is not None and (check := asked.check(self.notebook, answer)).verdict == "contradicts":
                    raise CannotTeach(
                        f"{asked.question}: {answer:g} {asked.unit} cannot be ({check.allowed}).", check.remedy
                    )
                how = "suggested, and agreed" if default and answer == float(default) else how
            value = int(answer) if isinstance(answer, float) and asked.whole else answer
            assert isinstance(value, int | float | str)
            self.keep(step, asked.field, value, how, asked.unit, sigma=asked.sigma)

    async def may_move(self, what: str) -> None:
        """Ask for the key that lets the arm move. Raises `CannotTeach` unless both it and `--arm` are given."""
        if not self.armed:
            raise CannotTeach(f"{what}: this moves the arm.", "Start the same command again with --arm.")
        question = f"{what}. The arm moves by itself, slower than 50 mm/s. Is nobody within its reach?"
        if await self.choose(question, (ARM, STAY), STAY.key) != ARM.key:
            raise CannotTeach("the arm was left where it is.", "Try this step again once it may move.")


class Step(ABC):
    """One step of the first day."""

    name: ClassVar[StepName]
    title: ClassVar[str]
    minutes: ClassVar[int]
    needs: ClassVar[tuple[StepName, ...]]
    """Steps whose values this one depends on."""
    observes: ClassVar[tuple[str, ...]] = ()
    """Beginnings of fields and kinds of touches that are forgotten when it is taught again."""

    @abstractmethod
    async def teach(self, day: Day) -> None:
        """Ask, measure and keep. Raises `WentBack`, `LeftOff`, `CannotTeach` and what the devices raise."""

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Values that follow from the notebook alone; computed again whenever a value they depend on changes."""
        return {}

    @abstractmethod
    def summary(self, notebook: Notebook) -> str:
        """What was taught, in a few words."""
