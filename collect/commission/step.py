"""What every step of the first day works with: the person, who is asked and shown things, the notebook, and motion."""

from __future__ import annotations

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from brushloop.collect.commission.notebook import Notebook, StepName, Taught, Value
from brushloop.collect.errors import NotAccepted, StepError
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.rig.check import Check
from brushloop.drivers.host import Clock
from brushloop.sessions.disk import number

Picture = NDArray[np.uint8]
"""(h, w) gray or (h, w, 3) BGR."""
ARM = Choice("a", "let it move: I look at the cell, my hand is at the emergency stop")
STAY = Choice("x", "leave it where it is")
YES, NO = Choice("y", "yes"), Choice("n", "no")
THERE, SKIP = Choice("enter", "it is there"), Choice("k", "skip it")
Tone = Literal["finding", "warning", "trouble"]
"""After a warning the step can go on; trouble ends it, and its last line says what to do."""


class LeftOff(Exception):
    """The person ended the session in the middle; everything taught so far is kept."""


class WentBack(Exception):
    """The person wants to go back one question: what was answered before this one is taken back, and asked again."""


@dataclass(frozen=True, slots=True)
class Asked:
    """One value that a person types or chooses: its field in `rig.toml`, the question, its range, and its check."""

    field: str
    question: str
    unit: str = ""
    low: float = 0.0
    high: float = 0.0
    """Range of a number; a text or a choice has none."""
    sigma: float | None = None
    default: str | Callable[[Notebook], str] = ""
    """What an empty line stands for; an empty text if it is no answer."""
    choices: tuple[Choice, ...] = ()
    check: Callable[[Notebook, float], Check] | None = None
    """Compares the number with what is known already."""
    read: Callable[[str], Value] = str
    """Reads a text; raises ValueError, worded for the person, where it cannot be used."""

    def prompt(self, notebook: Notebook) -> Prompt:
        """The question, with what its empty line stands for."""
        default = self.default if isinstance(self.default, str) else self.default(notebook)
        if self.choices:
            return choice_of(self.question, self.choices, default)
        allowed = f"{self.low:g} to {self.high:g} {self.unit}" if self.high > self.low else ""
        return Prompt(self.question, default=default, read=lambda line: self.value(line, notebook), allowed=allowed)

    def value(self, line: str, notebook: Notebook) -> Value:
        """What a line stands for. Raises ValueError, worded for the person, where it cannot be the value."""
        if self.high <= self.low:
            return self.read(line)
        try:
            value = number(line.replace(",", "."))
        except ValueError:
            raise ValueError(f"{line!r} is not a number") from None
        if not self.low <= value <= self.high:
            raise ValueError(f"{value:g} is outside {self.low:g} to {self.high:g} {self.unit}")
        if self.check is not None and (check := self.check(notebook, value)).verdict == "contradicts":
            raise ValueError(f"{value:g} {self.unit} cannot be ({check.allowed}). {check.remedy}")
        return value


def choice_of(question: str, choices: tuple[Choice, ...], default: str = "") -> Prompt:
    """A question with answers on keys; Enter stands for the default, or for nothing if there is none."""
    return Prompt(question, choices, default, answers={"enter": default} if default else {})


class Visit:
    """One session with a person at one rig. What is kept is on disk at once; a screen in another thread reads it."""

    def __init__(self, rig_path: Path, clock: Clock, *, armed: bool) -> None:
        """`armed`: the command line allows motion; the person is asked again each time. Raises `ConfigError`."""
        self.rig_path = rig_path
        self.clock = clock
        self.armed = armed
        self.asker = Asker(watched=True)
        self.notebook = Notebook.load(rig_path)
        self.step = ""
        """Which step is taught now."""
        self.findings: list[tuple[Tone, str]] = []
        self.picture: Picture | None = None
        """The newest picture of a finding."""
        self.live: Picture | None = None
        """What the camera sees now, while somebody guides something by it."""
        self.doing: tuple[str, float] = ("", time.monotonic())
        """What is at work while nothing is asked, empty where no step has said so, and since when."""
        self._answered: list[Notebook] = []
        """The notebook as it was at each question of this process that was answered."""

    # The notebook

    def save(self, notebook: Notebook) -> None:
        """Replace the notebook."""
        notebook.save(self.rig_path)
        self.notebook = notebook

    def keep(self, values: Mapping[str, Taught]) -> None:
        """Note values by their fields: after a loss of power all of them are known, or none."""
        self.save(self.notebook.with_values(values))

    def forget(self, *names: str) -> None:
        """Take values and touches out of the notebook, so that they are asked for again."""
        self.save(self.notebook.without(*names))

    @contextlib.contextmanager
    def asked_again_if_refused(self, *names: str) -> Generator[None]:
        """Forget values and touches of these names where they contradict each other; they are asked for again."""
        try:
            yield
        except (NotAccepted, StepError):
            self.forget(*names)
            raise

    def teach_afresh(self, step: Step) -> None:
        """Forget what a step observed; going back undoes that."""
        self._answered.append(self.notebook)
        self.save(self.notebook.without(*step.observes).reopened(step.name))

    def back(self) -> None:
        """Restore the notebook of the last answered question, if there is one, so that it is asked again."""
        if self._answered:
            self.save(self._answered.pop())

    # The person

    def say(self, *lines: str, tone: Tone = "finding", picture: Picture | None = None) -> None:
        """Show lines, and a picture if there is one."""
        self.findings.append((tone, "\n".join(lines)))
        self.picture = self.picture if picture is None else picture

    def working(self, what: str) -> None:
        """Show what is being done until the next question."""
        self.doing = what, time.monotonic()

    async def ask(self, prompt: Prompt, *, back: bool = True) -> Any:
        """Wait for an answer that the prompt allows, and let going `back` lead here. Raises `WentBack` and `LeftOff`.

        A step asks nothing that is in the notebook, so the notebook of now leads it to this question again; answers
        that were not kept are one with those before them.
        """
        notebook = self.notebook
        try:
            answer = await self.asker.ask(prompt)
        finally:
            self.working("")
        if back and not (self._answered and self._answered[-1] is notebook):
            self._answered.append(notebook)
        return answer

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str = "") -> str:
        """The key of one of the choices; `default` is taken for an empty answer, which is none if it is empty."""
        return str(await self.ask(choice_of(question, choices, default)))

    async def yes(self, question: str) -> bool:
        """Ask for yes or no; Enter is neither."""
        return await self.choose(question, (YES, NO)) == YES.key

    async def brought(self, thing: str, how: str, *, may_skip: bool = False) -> bool:
        """Ask the person to bring a thing somewhere; False if it is skipped, where it `may_skip`."""
        choices = (THERE, SKIP) if may_skip else (THERE,)
        answers = {choice.key: choice is THERE for choice in choices}
        return bool(await self.ask(Prompt(how, choices, thing=thing, answers=answers)))

    async def values(self, *values: Asked) -> None:
        """Ask for each of these values that is not known yet, and keep it."""
        for asked in values:
            if asked.field in self.notebook.values:
                continue
            prompt = asked.prompt(self.notebook)
            value = await self.ask(prompt)
            agreed = isinstance(value, float) and prompt.default and value == float(prompt.default)
            how = "suggested, and agreed" if agreed else f"typed: {asked.question}"
            self.keep({asked.field: Taught(value, how, asked.unit, asked.sigma)})

    async def may_move(self, what: str) -> None:
        """Ask for the key that lets the arm move. Raises `NotAccepted` unless both it and `--arm` are given."""
        if not self.armed:
            raise NotAccepted(f"{what}: this moves the arm.", "Start the same command again with --arm.")
        question = f"{what}. The arm moves by itself, slower than 50 mm/s. Is nobody within its reach?"
        if await self.choose(question, (ARM, STAY), STAY.key) != ARM.key:
            raise NotAccepted("the arm was left where it is.", "Try this step again once it may move.")


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
    async def carry_out(self, visit: Visit) -> None:
        """Ask, measure and keep. Raises `WentBack`, `LeftOff`, `NotAccepted` and what the devices raise."""

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Values that follow from the notebook alone; computed again whenever a value they depend on changes."""
        return {}
