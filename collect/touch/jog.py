"""Zero touch by the operator's eye and hand: steps up and down until the tip just touches."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from collect.asking import Asker, Choice, Prompt
from collect.errors import StepError
from collect.touch.arm import TouchArm
from collect.touch.config import JogTouchConfig
from collect.touch.reach import Reach
from collect.touch.results import Touch

NextJog = Callable[[float], Awaitable[float | None]]
"""Told where the tip is above the expected height, in mm; the step to make, up being positive, or None: it touches."""
ROUNDING_MM = 1e-6


async def touch_by_jog(
    arm: TouchArm, at_mm: tuple[float, float], reach: Reach, config: JogTouchConfig, next_jog: NextJog
) -> Touch:
    """One touch; the brush is left where the operator stopped.

    A step that would go below the travel limit, or above where the jog began, is shortened to it. Raises `StepError`
    where the operator asks for more at the lower limit, and for a step of a size that the configuration does not have.
    """
    z_mm = reach.start_z_mm
    rests_mm = await arm.to(*at_mm, z_mm)
    while (step_mm := await next_jog(rests_mm - reach.expected_z_mm)) is not None:
        if all(abs(abs(step_mm) - size) > ROUNDING_MM for size in config.steps_mm):
            raise StepError(f"a jog of {step_mm:g} mm is none of {', '.join(f'{s:g}' for s in config.steps_mm)} mm")
        if step_mm < 0.0 and z_mm <= reach.lowest_z_mm + ROUNDING_MM:
            raise StepError(f"nothing was touched down to {reach.lowest_z_mm:.2f} mm, the end of the travel")
        z_mm = min(max(z_mm + step_mm, reach.lowest_z_mm), reach.start_z_mm)
        rests_mm = await arm.to(*at_mm, z_mm)
    return Touch(*at_mm, rests_mm)


def asked(asker: Asker, config: JogTouchConfig) -> NextJog:
    """Jogs that are asked for on the screen, one prompt a step. An asker that nobody watches raises `NeedsOperator`."""
    small, middle, large = config.steps_mm
    keys = {"1": -large, "2": -middle, "3": -small, "8": small, "9": middle, "0": large}
    choices = (
        *(Choice(key, f"{'down' if step < 0 else 'up'} {abs(step):g} mm") for key, step in keys.items()),
        Choice("t", "the tip just touches"),
    )

    async def next_jog(above_mm: float) -> float | None:
        question = f"Jog until the tip just touches the paper. It is {above_mm:+.2f} mm from the expected height."
        key = await asker.ask(Prompt(question, choices, "t"))
        return keys.get(key)

    return next_jog
