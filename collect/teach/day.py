"""What every step works with: the person, the notebook, and what it may do."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncGenerator, Generator
from pathlib import Path
from typing import Protocol

from brushloop.collect.errors import CannotTeach, StepError
from brushloop.collect.operator import Choice
from brushloop.collect.teach.arm_reader import Address, ArmReader, reading
from brushloop.collect.teach.back import BackGuide
from brushloop.collect.teach.guide import Guide, Picture, Shown, Tone
from brushloop.collect.teach.store import Notebook, StepName, Taught, TaughtFile, Value, now_utc
from brushloop.drivers.host import Clock

ARM = Choice("a", "let it move: I look at the cell, my hand is at the emergency stop")
STAY = Choice("x", "leave it where it is")
YES, NO = Choice("y", "yes"), Choice("n", "no")


class Day:
    """One session with a person at one rig. Everything that is kept is on disk when the method returns."""

    def __init__(self, guide: Guide, rig_path: Path, clock: Clock, *, armed: bool) -> None:
        """`armed`: the command line allows motion; the person is asked again each time. Raises `ConfigError`."""
        self.person = guide
        """Asked directly where an answer cannot be taken back."""
        self.guide = BackGuide(guide, lambda: self.notebook)
        self.rig_path = rig_path
        self.clock = clock
        self.armed = armed
        self._held = False
        self._file = TaughtFile(rig_path)
        self.notebook: Notebook = self._file.load()

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
        *,
        unit: str = "",
        sigma: float | None = None,
        known: str = "",
    ) -> None:
        """Note one value."""
        taught = Taught(value=value, unit=unit, how=how, sigma=sigma, known=known, at=now_utc(), step=step)
        self.save(self.notebook.with_values({field: taught}))

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

    async def say(self, *lines: str, tone: Tone = "finding", picture: Picture | None = None) -> None:
        """Show lines to the person."""
        await self.guide.show(Shown(lines, picture, tone))

    async def working(self, what: str) -> None:
        """Show what is being done until the next finding or question."""
        await self.say(what, tone="progress")

    async def yes(self, question: str) -> bool:
        """Ask for yes or no; Enter is neither."""
        return await self.guide.choose(question, (YES, NO), "") == YES.key

    def back(self) -> bool:
        """Restore the notebook of the last answered question, so that it is asked again; False if there is none."""
        if (notebook := self.guide.take_back()) is None:
            return False
        self.save(notebook)
        return True

    async def may_move(self, what: str) -> None:
        """Ask for the key that lets the arm move. Raises `CannotTeach` unless both it and `--arm` are given."""
        if not self.armed:
            raise CannotTeach(f"{what}: this moves the arm.", "Start the same command again with --arm.")
        question = f"{what}. The arm moves by itself, slower than 50 mm/s. Is nobody within its reach?"
        if await self.guide.choose(question, (ARM, STAY), STAY.key) != ARM.key:
            raise CannotTeach("the arm was left where it is.", "Try this step again once it may move.")
        self.guide.settle()

    @contextlib.asynccontextmanager
    async def arm(self) -> AsyncGenerator[ArmReader]:
        """The arm that was found, for reading only."""
        address = Address(str(self.notebook.get("robot.host")), int(self.notebook.number("robot.port")))
        async with reading(address, self.notebook.framing) as reader:
            yield reader

    @contextlib.contextmanager
    def touched_again_if_refused(self, *kinds: str) -> Generator[None]:
        """Forget the touches of these kinds because they contradict each other; they are asked for again."""
        try:
            yield
        except (CannotTeach, StepError):
            self.save(self.notebook.without_touches(*kinds))
            raise


class Step(Protocol):
    """One step of the first day."""

    name: StepName
    title: str
    minutes: int
    needs: tuple[StepName, ...]
    """Steps whose values this one depends on."""

    async def teach(self, day: Day) -> None:
        """Ask, measure and keep. Raises `WentBack`, `LeftOff`, `CannotTeach` and what the devices raise."""
        ...

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Values that follow from the notebook alone; computed again whenever a value they depend on changes."""
        return {}

    def forget(self, notebook: Notebook) -> Notebook:
        """The notebook without what this step observed, for teaching it again; unchanged if that may stay."""
        return notebook

    def summary(self, notebook: Notebook) -> str:
        """What was taught, in a few words."""
        ...
