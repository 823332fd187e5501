"""Zero touch by jog: the operator steps the brush up and down until the tip just touches."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from collect.errors import JogGivenUp, StepError
from collect.operator import Asker, Choice, Prompt
from collect.rig.config_touch import JogTouchConfig
from collect.touch.arm import TouchArm
from collect.touch.heights import Reach, Touch


@dataclass(frozen=True, slots=True)
class Jogged:
    """Where the tip is, for the operator."""

    above_mm: float
    """Above the expected height."""
    lowest: bool
    """Whether it is at the end of the travel: nothing lower is allowed."""
    number: int
    """Number of the touch, from 1."""
    of: int
    """Touches of this point and of all others."""


NextJog = Callable[[Jogged], Awaitable[float | None]]
"""The next step in mm, positive up; None where the tip touches."""
ROUNDING_MM = 1e-6


async def touch_by_jog(
    arm: TouchArm,
    at_mm: tuple[float, float],
    reach: Reach,
    config: JogTouchConfig,
    next_jog: NextJog,
    number: int = 1,
    of: int = 1,
) -> Touch:
    """Touch `number` of `of`; the brush is left where the operator stopped.

    A step that would go below the end of the travel, or above where the jog began, is shortened. Raises `StepError` for
    a step of a size that the configuration does not have.
    """
    z_mm = reach.start_z_mm
    while True:
        rests_mm = await arm.to(*at_mm, z_mm)
        lowest = z_mm <= reach.lowest_z_mm + ROUNDING_MM
        step_mm = await next_jog(Jogged(rests_mm - reach.expected_z_mm, lowest, number, of))
        if step_mm is None:
            return Touch(*at_mm, rests_mm)
        if all(abs(abs(step_mm) - size) > ROUNDING_MM for size in config.steps_mm):
            raise StepError(f"a jog of {step_mm:g} mm is none of {', '.join(f'{s:g}' for s in config.steps_mm)} mm")
        z_mm = min(max(z_mm + step_mm, reach.lowest_z_mm), reach.start_z_mm)


def asked(asker: Asker, config: JogTouchConfig, height: str = "the height") -> NextJog:
    """Ask for each jog on the screen. `height` names the height that holds without a jog.

    What it returns raises `NeedsOperator` where nobody watches, and `JogGivenUp` where the operator gives up.
    """
    small, middle, large = config.steps_mm
    keys = {"1": -large, "2": -middle, "3": -small, "8": small, "9": middle, "0": large}
    choices = (
        *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in keys.items()),
        Choice("t", "the tip just touches"),
        Choice("x", f"give up: {height} stays as it was"),
    )

    async def next_jog(at: Jogged) -> float | None:
        question = (
            f"Touch {at.number} of {at.of}. Jog until the tip just touches the paper. "
            f"It is {at.above_mm:+.2f} mm from the expected height."
        )
        if at.lowest:
            question += (
                " This is the end of the travel: if nothing touches, give up, and correct touch_z_mm in rig.toml."
            )
        key = await asker.ask(Prompt(question, choices, "x"))
        if key == "x":
            raise JogGivenUp(at.number, at.of, height)
        return keys.get(key)

    return next_jog
