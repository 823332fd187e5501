"""The questions that follow from errors: what a person is asked, and what the answers mean."""

from __future__ import annotations

from collect.errors import ForceTooHigh, JogGivenUp, SheetFull, StepError, describe
from collect.operator import Choice, Prompt
from drivers.errors import ArmMoved, DeviceError, MotionError, SettingsChanged
from drivers.ink.port import InkRefused

STOP = Choice("x", "stop the run")
GO_ON = "g"
KEEP = "k"


def question(error: StepError | DeviceError, sheet: int) -> Prompt:
    """What to ask. The default is always to stop: nothing moves because nobody answered."""
    match error:
        case SheetFull():
            words = f"Sheet {sheet + 1} is full. Put a fresh one in, then go on."
            go_on = Choice(GO_ON, f"sheet {sheet + 2} is in, and blank")
        case InkRefused():
            words, go_on = f"{describe(error)}", Choice(GO_ON, "there is ink, dip again")
        case ForceTooHigh():
            words, go_on = describe(error), Choice(GO_ON, "nothing is under the brush, lift it and go on")
        case ArmMoved():
            words, go_on = describe(error), Choice(GO_ON, "nobody else has the arm, lift it and go on")
        case SettingsChanged():
            words, go_on = describe(error), Choice(GO_ON, "nobody else has the arm: set it anew, lift it and go on")
        case JogGivenUp(height=height):
            words = f"{describe(error)}. {height[0].upper()}{height[1:]} can be kept: H is then counted from there."
            return Prompt(words, (Choice(KEEP, "keep that height, go on"), Choice("a", "jog again"), STOP), STOP.key)
        case MotionError():
            words, go_on = describe(error), Choice(GO_ON, "the arm is released and clear, lift it and go on")
        case _:
            words, go_on = describe(error), Choice(GO_ON, "it is put right, try again")
    return Prompt(words, (go_on, STOP), STOP.key)
