"""People on a first day: one who leaves at once, and one in an unknown lab who passes requests on to the hand."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import math
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brushloop.collect.commission.visit import LeftOff, Taught, Tone, Value, Visit
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Asker, Prompt
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.paper import to_base
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.lab import UnknownLab
from brushloop.drivers.sim.lab_facts import Trap
from brushloop.drivers.sim.world import World, tool_of
from tests.waiting import PATIENCE_S


class Person(Asker):
    """Leaves at the first question."""

    def __init__(self) -> None:
        super().__init__(watched=True)
        self.asked: list[str] = []
        self.shown: list[tuple[Tone, str]] = []

    def visit(self, rig_path: Path, *, armed: bool = False) -> Visit:
        """A visit that asks this person, who remembers what every visit showed."""
        visit = Visit(rig_path, HostClock(), armed=armed)
        visit.asker, visit.findings = self, self.shown
        return visit

    async def ask(self, prompt: Prompt) -> Any:
        self.asked.append(prompt.question)
        raise LeftOff


@pytest.fixture
async def server() -> AsyncIterator[ArcsServer]:
    server = ArcsServer(World(SimConfig(rate=10.0)))
    await server.start("127.0.0.1", 0)
    yield server
    await server.stop()


def visit_of(
    person: Person,
    folder: Path,
    port: int = 9,
    *,
    tip_mm: tuple[float, float, float] = (0.0, 0.0, 180.0),
) -> Visit:
    """A visit on which the arm and its tip are known."""
    visit = person.visit(folder / "rig.toml")
    values: dict[str, Value] = {
        "robot.host": "127.0.0.1",
        "robot.port": port,
        "robot.framing": "sof",
        "robot.tcp_offset_mm": list(tip_mm),
        "robot.tcp_rotation_deg": [0.0, 0.0, 0.0],
    }
    visit.keep({field: Taught(value, "typed") for field, value in values.items()})
    return visit


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
        return default or ("y" if "Agreed?" in question else "n")

    def _typed(self, question: str) -> str:
        if question.startswith("Address of the camera"):
            return next(self._streams)
        lab, facts = self.lab, self.lab.facts
        table, brush = facts.config.table, facts.config.brush
        read = {
            "Address of the cabinet": lab.host,
            "Squares of the print": "{}x{}".format(*table.board_squares),
            "Side of a square": str(facts.printed_square_mm),
            "Side of a marker": str(facts.printed_marker_mm),
            "Markers of the print": table.board_dictionary,
            "R:": str(brush.radius_mm),
            "L:": str(brush.length_mm),
            "Deepest press": str(facts.max_depth_mm),
            "Delivery per revolution": "0.1",
            "Its serial line": "" if lab.ink is None else lab.ink.path,
            "CAN bus": lab.can_bus,
        }
        return next((v for start, v in read.items() if question.startswith(start)), "")

    async def bring(self, thing: str) -> bool:
        if self.leave_after is not None and len(self.brought) >= self.leave_after:
            raise LeftOff
        self.brought.append(thing)
        kind, index, *corner = thing.split(" ", 2)
        answer = await self._in_lab(self.lab.bring(kind, int(index), *corner))
        return bool(answer["reached"])

    @property
    def trouble(self) -> str:
        return " ".join(text.replace("\n", " ") for tone, text in self.shown if tone == "trouble")

    async def _in_lab(self, work: Any) -> Any:
        return await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(work, self.loop))


@contextlib.contextmanager
def in_lab(seed: int, trap: Trap | None = None, **options: Any) -> Iterator[InLab]:
    """The lab serves from a thread of its own until the block ends."""
    ready: Future[tuple[UnknownLab, asyncio.AbstractEventLoop, asyncio.Event]] = Future()

    async def serve() -> None:
        over = asyncio.Event()
        try:
            async with UnknownLab(seed, trap, **options) as lab:
                ready.set_result((lab, asyncio.get_running_loop(), over))
                await over.wait()
        except BaseException as error:
            if not ready.done():
                ready.set_exception(error)
            raise

    thread = threading.Thread(target=lambda: asyncio.run(serve()), name="unknown lab", daemon=True)
    thread.start()
    lab, loop, over = ready.result(timeout=PATIENCE_S)
    try:
        yield InLab(lab, loop)
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(timeout=PATIENCE_S)
        assert not thread.is_alive(), f"waited {PATIENCE_S:g} s for the lab to end"


async def first_day(person: InLab, rig_path: Path, *, armed: bool = True) -> Path | None:
    """Run the wizard once; None where the person left off."""
    try:
        return await Wizard(person.visit(rig_path, armed=armed)).run()
    except CollectAborted:
        return None


def newest_session(rig_path: Path) -> Path:
    """The folder of the last proof's recording."""
    return max(rig_path.parent.glob("rig.proof-*/sessions/*"), key=lambda session: session.stat().st_mtime)


@dataclass(frozen=True, slots=True)
class Errors:
    """What a first day got wrong; base frame, against the truth."""

    tcp_mm: float
    origin_mm: float
    yaw_deg: float
    touch_mm: float
    """Of the true tip above the true sheet at the touch point, with the arm at the taught height."""
    delay_share: float

    @property
    def within(self) -> bool:
        """Whether all are within the limits that a first day promises."""
        return (
            self.tcp_mm <= 0.5
            and self.origin_mm <= 0.5
            and self.yaw_deg <= 0.2
            and self.touch_mm <= 0.1
            and self.delay_share <= 0.2
        )

    def __str__(self) -> str:
        return (
            f"TCP {self.tcp_mm:.2f} mm, origin {self.origin_mm:.2f} mm, yaw {self.yaw_deg:.2f} deg, touch "
            f"{self.touch_mm:.3f} mm, delay {100 * self.delay_share:.0f} %"
        )


def errors(rig_path: Path, lab: UnknownLab) -> Errors:
    """Compare a `rig.toml` with the truth of its lab."""
    rig, tool = load_rig(rig_path), tool_of(lab.facts.config)
    tcp_error = np.array(rig.robot.tcp_offset_mm) - 1e3 * tool[:3, 3]
    paper = rig.paper
    x, y = to_base(paper, *paper.touch_point_mm)
    table = lab.facts.config.table
    paper_x, paper_y = lab.world.config.table.to_paper(x, y)
    # A brush held upright with a tool that is taken for too long stands that much higher.
    true_tip_z_mm = paper.touch_z_mm + float(tcp_error @ tool[:3, 2])
    delay_s = lab.facts.config.view.delay_s + 0.5 * lab.facts.config.view.delay_jitter_s
    return Errors(
        float(np.linalg.norm(tcp_error)),
        math.dist(paper.origin_mm, table.origin_mm),
        abs(math.remainder(paper.yaw_deg - table.yaw_deg, 360.0)),
        abs(true_tip_z_mm - table.surface_z_mm(paper_x, paper_y)),
        abs(rig.camera.latency_ms / 1e3 - delay_s) / delay_s,
    )
