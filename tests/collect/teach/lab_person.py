"""A person in an unknown lab: reads the labels, guides the arm, and sees to what the wizard names."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from collect.operator import Choice
from collect.teach.guide import Brought, JogStep, JogView, Shown, StepState, Target
from drivers.sim.fault_client import ask
from drivers.sim.lab.traps import Trap

NAMED = {
    Trap.SWAPPED_CORNER: ("swapped", "taken for"),
    Trap.MIRRORED_CAMERA: ("mirror",),
    Trap.WRONG_BOARD_SIZE: ("of the size that its print gives",),
    Trap.TCP_IN_METRES: ("metres were typed",),
    Trap.PARK_IN_PICTURE: ("is in the picture",),
    Trap.SLOW_CAMERA: ("camera is slow", "refused", "delay"),
    Trap.FORCE_SIGN: ("other way round",),
    Trap.SHEET_OUT_OF_REACH: ("out of its reach", "does not reach"),
    Trap.OLD_SOFTWARE: ("older software",),
    Trap.CABLE_PULLED: ("Check power, cable", "cable"),
}
"""Words of which one names the trap."""


MOST_TROUBLES = 5
"""After which a person leaves. On a busy machine a simulated device may answer too late once or twice."""


@dataclass(frozen=True)
class Lab:
    """`brushloop sim --unknown` as a process, known by what it prints and by its control socket."""

    lines: list[str]
    control: Path
    truth_file: Path

    async def obey(self, **request: object) -> dict[str, Any]:
        """One request to the person's hand."""
        return await asyncio.to_thread(ask, self.control, {"do": "hand", **request})

    def state(self) -> dict[str, Any]:
        """The world as only a test may see it."""
        return ask(self.control, {"do": "state"})

    def truth(self) -> dict[str, Any]:
        """What only a test may read."""
        return json.loads(self.truth_file.read_text())

    def find(self, pattern: str) -> list[tuple[str, ...]]:
        """The groups of a pattern in every line that it fits."""
        return [found.groups() for line in self.lines if (found := re.search(pattern, line))]


@contextmanager
def served(seed: int, trap: Trap | None, folder: Path, rate: float = 20.0) -> Iterator[Lab]:
    """Serve until the block ends."""
    control, truth = folder / "lab.sock", folder / "truth.json"
    words = ["sim", "--unknown", str(seed), "--rate", f"{rate:g}", "--control", str(control), "--truth", str(truth)]
    command = [sys.executable, "-u", "-m", "brushloop", *words, *(["--trap", trap.value] if trap else [])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            lines = list(iter(process.stdout.readline, "Ctrl-C ends\n"))[:40]
            yield Lab([line.rstrip() for line in lines], control, truth)
        finally:
            process.terminate()


@dataclass
class LabPerson:
    """`Guide`: answers from what is seen in the lab; after trouble, sees to it once and tries again."""

    lab: Lab
    trap: Trap | None = None
    """What is wrong in the lab. The person sees to it once the wizard has named it, not before."""
    lines: list[str] = field(default_factory=list)
    typed: dict[str, float] = field(default_factory=dict)
    """Every number that was typed, by its question."""
    mended: list[str] = field(default_factory=list)
    square_mm: float | None = None
    """As measured by calipers, once the wizard has doubted the print."""
    _troubles: int = 0

    def names(self, trap: Trap) -> bool:
        return any(word in line for word in NAMED[trap] for line in self.lines)

    async def overview(self, steps: tuple[StepState, ...]) -> None:
        pass

    async def show(self, what: Shown) -> None:
        self.lines += what.lines
        if what.tone == "trouble":
            self._troubles += 1

    async def choose(self, question: str, choices: tuple[Choice, ...], default: str) -> str:
        if question == "How to go on?":
            return await self._after_trouble()
        if "arm moves by itself" in question:
            return "a"
        if question.startswith("What keeps the ink well filled"):
            device = next((kind for kind in ("pump", "station") if self.lab.find(f"^ink .*{kind} on")), "by hand")
            return next(choice.key for choice in choices if device in choice.label)
        if question.startswith("Is there a pot of water"):
            return "y"
        return default

    async def _after_trouble(self) -> str:
        """See to the trap if the wizard has named it; otherwise try again, and leave after too much trouble."""
        if self.trap is None or not self.names(self.trap):
            return "a" if self._troubles < MOST_TROUBLES else "q"
        trap, self.trap = self.trap, None
        act = "plug" if trap is Trap.CABLE_PULLED else "mend"
        self.mended.append((await self.lab.obey(act=act))["says"])
        if trap is Trap.WRONG_BOARD_SIZE:
            self.square_mm = float((await self.lab.obey(act="measure", to="square"))["says"])
            return "q"
        return "a"

    async def number(self, question: str, unit: str, low: float, high: float, default: float | None) -> float:
        [print_] = self.lab.find(r"(\d+) x (\d+) squares of ([\d.]+) mm, markers of ([\d.]+) mm")
        columns, rows, square_mm, marker_mm = map(float, print_)
        shrunk = 1.0 if self.square_mm is None else self.square_mm / square_mm
        [brush] = self.lab.find(r"R = ([\d.]+) mm, length L = ([\d.]+) mm, press at most ([\d.]+) mm")
        radius_mm, length_mm, deepest_mm = map(float, brush)
        known = {
            "Squares along its longer": max(columns, rows),
            "Squares along its shorter": min(columns, rows),
            "Side of a square": shrunk * square_mm,
            "Side of a marker": shrunk * marker_mm,
            "R:": radius_mm,
            "L:": length_mm,
            "Deepest press": deepest_mm,
            "Delivery per revolution": 0.1,
        }
        value = next((v for start, v in known.items() if question.startswith(start)), default)
        assert value is not None, question
        assert low <= value <= high, question
        self.typed[question] = value
        return value

    async def text(self, question: str, default: str) -> str:
        [[host]] = self.lab.find(r"pendant shows the address (\S+)")
        [[gateway, port, bus]] = self.lab.find(r"gateway (\S+) port (\d+), bus (\S+)")
        known = {
            "Address of the cabinet": host,
            "Address of the camera": " ".join(stream for (stream,) in self.lab.find(r"^camera +(\S+)")),
            "Markers of the print": self.lab.find(r"(DICT_\S+)")[0][0],
            "CAN bus": f"{gateway}:{port}/{bus}",
            "Its serial line": "".join(line for (line,) in self.lab.find(r"^ink .* on (\S+)")),
        }
        return next((answer for start, answer in known.items() if question.startswith(start)), default)

    async def bring(self, target: Target, how: str) -> Brought:
        answer = await self.lab.obey(act="bring", to=target.kind, index=target.index, corner=target.corner)
        return Brought.DONE if answer["reached"] else Brought.SKIP

    async def jog(self, view: JogView) -> JogStep | Brought:
        return Brought.DONE
