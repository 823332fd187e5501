"""A first day that asks one question of each kind, for tests of its screen."""

from __future__ import annotations

import asyncio
from typing import Any

import cv2
import numpy as np

from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Choice
from brushloop.collect.teach.guide import Brought, JogView, Question, Shown, StepState, Target
from brushloop.collect.tui.teach_app import TeachApp
from brushloop.collect.tui.teach_guide import ScreenGuide
from brushloop.drivers.geometry import brush_pose

STEPS = (
    StepState("arm", "Find the arm", 3, "taught", "192.0.2.7:30004"),
    StepState("camera", "Find the camera", 12, "taught", "2048 x 1536, 8 Hz"),
    StepState("tip", "Tip of the brush", 8, "current"),
    *(StepState(name, name.capitalize(), 5, "open") for name in ("sheet", "places", "brush", "force", "limits")),
    StepState("proof", "Proof", 6, "open"),
)
FOUND = Shown(("five directions: the tip is known to 0.11 mm", "residuals 0.10, 0.24, 0.08, 0.17, 0.21 mm"))
WARNED = Shown(("direction 2 is like direction 1: lean the brush farther",), tone="warning")
YES, NO = Choice("y", "yes, take it"), Choice("n", "no, touch it again")
JOG = JogView(
    (0.0, 0.1, -1.3),
    (0.1, 0.5, 2.0, 5.0),
    "not made: z = 97.900 mm is outside [98.200, 148.000] mm. Guide the arm by hand to go farther",
)


def board() -> np.ndarray:
    squares = cv2.aruco.CharucoBoard((7, 5), 20.0, 15.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    return squares.generateImage((560, 400), marginSize=20)


class Asking:
    """Asks the given questions, and notes the answers."""

    def __init__(self, *kinds: str) -> None:
        self.kinds = kinds
        self.answers: list[object] = []
        self.at_work = self.stopped_arm = False

    async def __call__(self, guide: ScreenGuide) -> None:
        await guide.overview(STEPS)
        await guide.show(FOUND)
        await guide.show(WARNED)
        guide.see_pose(brush_pose(412.25, -31.5, 121.75), True)
        for kind in self.kinds:
            self.answers.append(await self._ask(guide, kind))
        return None

    async def _ask(self, guide: ScreenGuide, kind: str) -> Any:
        match kind:
            case "choose":
                return await guide.ask(Question("choose", "Take this tip?", (YES, NO), "y"))
            case "no default":
                return await guide.ask(Question("choose", "Is there a pot of water?", (YES, NO)))
            case "number":
                return await guide.ask(
                    Question("number", "Squares along its longer side", unit="squares", low=3, high=50)
                )
            case "text":
                return await guide.ask(Question("text", "Address of the cabinet", default="192.0.2.7"))
            case "empty":
                return await guide.ask(Question("text", "CAN bus of the force sensor; Enter: no sensor"))
            case "bring":
                await guide.show(Shown(("the board as the camera sees it",), board()))
                how = "Guide the tip to the pin by hand, the brush leaning toward the window, then press Enter."
                return await guide.ask(Question("bring", how, target=Target("pin", 2), may_jog=True, may_skip=True))
            case "jog":
                lower = Question("jog", "Lower the tip onto the paper.", jog=JOG)
                while not isinstance(answer := await guide.ask(lower), Brought):
                    self.answers.append(answer)
                return answer
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


def app_of(asking: Asking) -> TeachApp:
    return TeachApp(asking, "rig.toml")
