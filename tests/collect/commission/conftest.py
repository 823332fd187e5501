"""People on a first day: one who leaves at once, and one in an unknown lab who passes requests on to the hand."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.collect.commission.visit import LeftOff, Tone, Visit, WentBack
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Asker, Prompt
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.paper import to_base
from brushloop.drivers.host import Clock
from brushloop.drivers.sim.lab import UnknownLab
from brushloop.drivers.sim.lab_facts import Trap
from brushloop.drivers.sim.world import tool_of
from tests.rigs import in_thread


class Person(Asker):
    """Leaves at the first question."""

    def __init__(self) -> None:
        super().__init__(watched=True)
        self.asked: list[str] = []
        self.shown: list[tuple[Tone, str]] = []

    @property
    def trouble(self) -> str:
        return " ".join(text for tone, text in self.shown if tone == "trouble")

    def visit(self, rig_path: Path, *, armed: bool = False) -> Visit:
        """A visit that asks this person, who remembers what every visit showed."""
        visit = Visit(rig_path, Clock(), armed=armed)
        visit.asker, visit.findings = self, self.shown
        return visit

    async def ask(self, prompt: Prompt) -> Any:
        self.asked.append(prompt.question)
        raise LeftOff


BACK = "<"


class Answering(Person):
    """Answers with one line or key after the other, an empty one for the default; `BACK` goes back, the end leaves."""

    def __init__(self, *answers: str) -> None:
        super().__init__()
        self.answers = list(answers)

    async def ask(self, prompt: Prompt) -> Any:
        self.asked.append(prompt.question.split(":")[0].split(",")[0])
        if not self.answers:
            raise LeftOff
        if (answer := self.answers.pop(0)) == BACK:
            raise WentBack
        answer = answer or prompt.default
        return prompt.answer_to(answer) if prompt.read is None else prompt.read(answer)


# In an unknown lab

KEYS = {"station": "i", "pump": "p", "none": "n"}


class InLab(Person):
    """A person in an unknown lab, whose servers run in another thread."""

    def __init__(self, lab: UnknownLab, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self.lab, self.loop = lab, loop
        self._streams = itertools.cycle(lab.streams)
        self.brought: list[str] = []
        self.leave_after: int | None = None
        """Number of requests to bring something after which the session is cut."""
        self.mends = False
        """Whether the person sees to what the wizard names, and goes on."""

    async def ask(self, prompt: Prompt) -> Any:
        if prompt.thing:
            return await self.bring(prompt.thing)
        self.asked.append(prompt.question)
        if prompt.read is not None:
            return prompt.read(self._typed(prompt.question) or prompt.default)
        return prompt.answer_to(await self._choose(prompt.question, prompt.default))

    async def _choose(self, question: str, default: str) -> str:
        if question.startswith("How do you want to go on"):
            if not self.mends:
                raise LeftOff
            await self._in_lab(self.lab.mend())
            self.mends = False
            return "a"
        if question.startswith("What keeps the ink well filled"):
            return KEYS[self.lab.facts.config.ink_device]
        if "The arm moves by itself" in question:
            return "a"
        return default or ("y" if question.endswith(("Agreed?", "Go on with 0 kg?")) else "n")

    def _typed(self, question: str) -> str:
        if question.startswith("Address of the camera"):
            return next(self._streams)
        lab, facts = self.lab, self.lab.facts
        table, brush = facts.config.table, facts.config.brush
        read = {
            "Address of the cabinet": lab.host,
            "Squares of the print": "{}x{}".format(*table.board_squares),
            "Side of a square": str(facts.printed_mm[0]),
            "Side of a marker": str(facts.printed_mm[1]),
            "Family of the board's markers": table.board_dictionary,
            "R:": str(brush.radius_mm),
            "L:": str(brush.length_mm),
            "Deepest press": str(facts.max_depth_mm),
            "Ink per revolution": "0.1",
            "Serial line of the device": lab.ink_path,
            "CAN bus": lab.can_bus,
        }
        return next((v for start, v in read.items() if question.startswith(start)), "")

    async def bring(self, thing: str) -> bool:
        if self.leave_after is not None and len(self.brought) >= self.leave_after:
            raise LeftOff
        self.brought.append(thing)
        kind, index, *corner = thing.split(" ", 2)
        with contextlib.suppress(ValueError):
            await self._in_lab(self.lab.bring(kind, int(index), *corner))
            return True
        return False

    async def _in_lab(self, work: Any) -> Any:
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self.loop))


@contextlib.contextmanager
def in_lab(seed: int, trap: Trap | None = None, **options: Any) -> Iterator[InLab]:
    """The lab serves from a thread of its own until the block ends."""
    with in_thread(UnknownLab(seed, trap, **options)) as (lab, loop):
        yield InLab(lab, loop)


async def first_day(person: InLab, rig_path: Path, *, armed: bool = True) -> Path | None:
    """Run the wizard once; None where the person left off."""
    try:
        return await Wizard(person.visit(rig_path, armed=armed)).run()
    except CollectAborted:
        return None


def newest_session(rig_path: Path) -> Path:
    """The folder of the last proof's recording."""
    return max(rig_path.parent.glob("rig.proof-*/sessions/*"), key=lambda session: session.stat().st_mtime)


LIMITS = {"tip_mm": 0.5, "origin_mm": 0.5, "yaw_deg": 0.2, "touch_mm": 0.1}
"""Errors of a proven rig that a first day promises."""


def errors(rig_path: Path, lab: UnknownLab) -> dict[str, float]:
    """Compare a `rig.toml` with the truth of its lab, in the base frame."""
    rig, tool = load_rig(rig_path), tool_of(lab.facts.config)
    paper, table = rig.paper, lab.facts.config.table
    tip_error = np.array(rig.robot.tcp_offset_mm) - 1e3 * tool[:3, 3]
    # A brush held upright with a tool that is taken for too long stands that much higher.
    true_tip_z_mm = paper.touch_z_mm + float(tip_error @ tool[:3, 2])
    sheet_z_mm = table.surface_z_mm(*table.to_paper(*to_base(paper, *paper.touch_point_mm)))
    return {
        "tip_mm": float(np.linalg.norm(tip_error)),
        "origin_mm": math.dist(paper.origin_mm, table.origin_mm),
        "yaw_deg": abs(math.remainder(paper.yaw_deg - table.yaw_deg, 360.0)),
        "touch_mm": abs(true_tip_z_mm - sheet_z_mm),
    }
