"""Step 3: the tip of the brush. The same pin is touched from many sides; the program only reads."""

from __future__ import annotations

from collect.teach.day import Day
from collect.teach.errors import CannotTeach
from collect.teach.guide import Target
from collect.teach.maths.tip import LEAST_TOUCHES, find_tip
from collect.teach.store import Notebook, StepName, Taught, now_utc

MOST_TOUCHES = 24
GOOD_MM = 0.17
"""Root mean square error of the tip at which touching ends."""
WORST_MM = 0.35
"""Above this after the last touch, the tip is not accepted."""
SIDES = ("away from you", "to the right", "toward you", "to the left")


class TipStep:
    """The offset from the flange to the tip of the brush."""

    name: StepName = "tip"
    title = "Tip of the brush"
    minutes = 8
    needs: tuple[StepName, ...] = ("arm",)

    async def teach(self, day: Day) -> None:
        """Have the pin touched until the tip is known well enough. Raises `CannotTeach`."""
        await day.say(
            "Fix a pin upright where all sides of it can be reached; put the pendant into hand guiding.",
            "Touch its point with the tip of the dry brush, each time leaning to another side, and hold still.",
        )
        async with day.arm() as reader:
            if await self._known(day):
                return
            for index in range(MOST_TOUCHES):
                if f"pin {index}" in day.notebook.touches:
                    continue
                how = (
                    f"Touch {index + 1}: bring the tip to the pin, the brush leaning by 30 deg or more "
                    f"{SIDES[index % 4]}; lean it without turning the wrist along."
                )
                await day.touch(reader, Target("pin", index), how, f"pin {index}")
                if await self._known(day):
                    return
        with day.touched_again_if_refused("pin"):
            fit = find_tip(list(day.notebook.touched("pin").values()))
            if fit.error_mm > WORST_MM:
                raise CannotTeach(
                    f"after {MOST_TOUCHES} touches the tip is known to {fit.error_mm:.2f} mm only.",
                    "Fix pin and brush firmly, hold still while you press Enter, and touch the pin again.",
                )

    async def _known(self, day: Day) -> bool:
        touches = day.notebook.touched("pin")
        if len(touches) < LEAST_TOUCHES:
            return False
        try:
            fit = find_tip(list(touches.values()))
        except CannotTeach as error:
            await day.say(str(error), tone="warning")
            return False
        slip = fit.slip()
        if slip is not None:
            name = list(touches)[slip]
            await day.say(
                f"Touch {int(name) + 1} lies {fit.residuals_mm[slip]:.1f} mm off: it is left out.", tone="warning"
            )
            kept = {key: t for key, t in day.notebook.touches.items() if key != f"pin {name}"}
            day.save(day.notebook.model_copy(update={"touches": kept}))
            return False
        x, y, z = fit.offset_mm
        await day.say(
            f"{len(touches)} touches: the tip is at ({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange, known to "
            f"{fit.error_mm:.2f} mm (goal {GOOD_MM:g}); the touches scatter by {max(fit.residuals_mm):.2f} mm at most."
        )
        return fit.error_mm <= GOOD_MM

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """The offset."""
        touches = list(notebook.touched("pin").values())
        fit = find_tip(touches)
        known = (
            f"95 % interval of the worst component +-{fit.reach_mm:.2f} mm, condition {fit.condition:.0f}, residuals "
            f"up to {max(fit.residuals_mm):.2f} mm"
        )
        how = f"the same pin touched from {len(touches)} sides by hand"
        return {
            "robot.tcp_offset_mm": Taught(
                value=list(fit.offset_mm),
                unit="mm",
                how=how,
                sigma=fit.error_mm,
                known=known,
                at=now_utc(),
                step="tip",
            )
        }

    def forget(self, notebook: Notebook) -> Notebook:
        """Without the touches."""
        return notebook.without_touches("pin")

    def summary(self, notebook: Notebook) -> str:
        """The length."""
        x, y, z = notebook.numbers("robot.tcp_offset_mm")
        return f"({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange"
