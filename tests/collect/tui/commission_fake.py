"""A first day that asks one question of each kind, for tests of its screen."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from brushloop.collect.commission.arm import ADDRESS
from brushloop.collect.commission.brush import BUS
from brushloop.collect.commission.camera import PRINT
from brushloop.collect.commission.step import Guide, Shown, Visit
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Choice
from brushloop.collect.tui.commission_app import CommissionApp
from brushloop.drivers.host import HostClock

FOUND = Shown(("five directions: the tip is known to 0.11 mm", "residuals 0.10, 0.24, 0.08, 0.17, 0.21 mm"))
WARNED = Shown(("direction 2 is like direction 1: lean the brush farther",), tone="warning")
YES, NO = Choice("y", "yes, take it"), Choice("n", "no, touch it again")


def board() -> np.ndarray:
    squares = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    return squares.generateImage((560, 400), marginSize=20)


class Asking:
    """Asks the given questions, and notes the answers."""

    def __init__(self, *kinds: str) -> None:
        self.kinds = kinds
        self.answers: list[object] = []
        self.at_work = self.stopped_arm = False

    async def __call__(self, guide: Guide) -> None:
        guide.step = "step 3 of 9: Tip of the brush, about 8 min"
        guide.show(FOUND)
        guide.show(WARNED)
        for kind in self.kinds:
            self.answers.append(await self._ask(guide, kind))
        return None

    async def _ask(self, guide: Guide, kind: str) -> Any:
        visit = Visit(guide, Path("rig.toml"), HostClock(), armed=False)
        match kind:
            case "choose":
                return await visit.choose("Take this tip?", (YES, NO), "y")
            case "no default":
                return await visit.yes("Is there a pot of water?")
            case "number":
                return await visit.ask(PRINT[0].prompt(visit.notebook))
            case "text":
                return await visit.ask(replace(ADDRESS, default="192.0.2.7").prompt(visit.notebook))
            case "empty":
                return await visit.ask(BUS.prompt(visit.notebook))
            case "bring":
                guide.show(Shown(("the board as the camera sees it",), board()))
                how = "Guide the tip to the pin by hand, the brush leaning toward the window, then press Enter."
                return await visit.brought("pin 2", how, may_skip=True)
            case _:
                return await self._move(kind)

    async def _move(self, kind: str) -> None:
        """A move that a driver stops when it is cancelled, or a run that ends by itself then."""
        self.at_work = True
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            self.stopped_arm = True
            if kind == "run":
                raise CollectAborted("stopped") from None
            raise


def app_of(asking: Asking) -> CommissionApp:
    return CommissionApp(asking, "rig.toml")
