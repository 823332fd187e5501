"""Step 3: the tip of the brush. The same pin is touched from many sides; the program only reads."""

from __future__ import annotations

from collect.errors import CannotTeach
from collect.teach.arm_reader import ArmReader
from collect.teach.day import Day, Step
from collect.teach.guide import Target
from collect.teach.jog import touch
from collect.teach.maths.tip import LEAST_TOUCHES, elsewhere, find_axis, find_tip
from collect.teach.store import Notebook, StepName, Taught, now_utc

MOST_TOUCHES = 24
GOOD_MM = 0.18
"""Root mean square error of the tip at which touching ends."""
WORST_MM = 0.35
"""Above this after the last touch, the tip is not accepted."""
UNKNOWN_MM = 20.0
"""Error above which no place of the tip is shown."""
LEAST_UPRIGHTS, UPRIGHTS = 3, 12
"""Times that the brush is held against a set square, each with another turn of the wrist. An upright brush bends along
the heading only by the few degrees of its set, so an error of 0.12 deg across the heading turns every mark by 5 deg,
and the mark is judged bent. Twelve times, each accurate to 0.15 deg, leave 0.04 deg."""
LEAST_LEAN = 3.0
"""A lean of the brush against the flange counts from this many standard errors."""
SIDES = ("away from you", "to the right", "toward you", "to the left")


class TipStep(Step):
    """The offset from the flange to the tip of the brush."""

    name: StepName = "tip"
    title = "Tip of the brush"
    minutes = 9
    needs: tuple[StepName, ...] = ("arm",)

    async def teach(self, day: Day) -> None:
        """Have the pin touched until the tip is known well enough. Raises `CannotTeach`."""
        await day.say(
            "Fix a pin upright where all sides of it can be reached; put the pendant into hand guiding.",
            "Touch its point with the tip of the dry brush, each time leaning to another side, and hold still.",
        )
        async with day.arm() as reader:
            await self._pin(day, reader)
            await day.say("Now the direction of the brush: hold it upright, a set square on the table beside it.")
            for index in range(UPRIGHTS):
                how = (
                    f"Upright {index + 1} of {UPRIGHTS}: the brush upright along the set square"
                    f"{', the wrist turned differently than before' if index else ''}, anywhere over the table."
                )
                if await touch(day, reader, Target("upright", index, may_skip=True), how, f"upright {index}") is None:
                    break

    async def _pin(self, day: Day, reader: ArmReader) -> None:
        if await self._known(day):
            return
        for index in range(MOST_TOUCHES):
            if f"pin {index}" in day.notebook.touches:
                continue
            how = (
                f"Touch {index + 1}: bring the tip to the pin, the brush leaning by 30 deg or more "
                f"{SIDES[index % 4]}; lean it without turning the wrist with it."
            )
            await touch(day, reader, Target("pin", index, may_skip=True), how, f"pin {index}")
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
        slip, off_mm = elsewhere(list(touches.values())) or fit.slip() or (None, 0.0)
        if slip is not None:
            name = list(touches)[slip]
            await day.say(f"Touch {int(name) + 1} lies {off_mm:.1f} mm off: it is left out.", tone="warning")
            kept = {key: t for key, t in day.notebook.touches.items() if key != f"pin {name}"}
            day.save(day.notebook.model_copy(update={"touches": kept}))
            return False
        x, y, z = fit.offset_mm
        if fit.error_mm > UNKNOWN_MM:
            more = f"{len(touches)} touches do not give the tip yet; if Enter was pressed too early, the next"
            await day.say(f"{more} touches will show which one lies off.", tone="warning")
            return False
        await day.say(
            f"{len(touches)} touches: the tip is at ({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange, known to "
            f"{fit.error_mm:.3f} mm (goal {GOOD_MM:g}); the touches scatter by {max(fit.residuals_mm):.2f} mm at most."
        )
        return fit.error_mm <= GOOD_MM

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """The offset, and how the brush leans against the flange."""
        touches = list(notebook.touched("pin").values())
        fit, now = find_tip(touches), now_utc()
        offset = Taught(
            value=list(fit.offset_mm),
            unit="mm",
            how=f"the same pin touched from {len(touches)} sides by hand",
            sigma=fit.error_mm,
            known=f"95 % interval of the worst component +-{fit.reach_mm:.2f} mm, condition {fit.condition:.0f}, "
            f"residuals up to {max(fit.residuals_mm):.2f} mm",
            at=now,
            step="tip",
        )
        uprights = list(notebook.touched("upright").values())
        if len(uprights) < LEAST_UPRIGHTS:
            square = Taught(
                value=[0.0, 0.0, 0.0],
                unit="deg",
                how="taken as square to the flange",
                known="not measured",
                at=now,
                step="tip",
            )
            return {"robot.tcp_offset_mm": offset, "robot.tcp_rotation_deg": square}
        axis = find_axis(uprights)
        leans = axis.lean_deg > LEAST_LEAN * axis.sigma_deg
        return {
            "robot.tcp_offset_mm": offset,
            "robot.tcp_rotation_deg": Taught(
                value=list(axis.rotation_deg) if leans else [0.0, 0.0, 0.0],
                unit="deg",
                how=f"held upright along a set square {len(uprights)} times",
                sigma=axis.sigma_deg,
                known=f"leans by {axis.lean_deg:.2f} deg against the flange"
                + ("" if leans else ", no more than the hand's error: taken as square"),
                at=now,
                step="tip",
            ),
        }

    def forget(self, notebook: Notebook) -> Notebook:
        """Without the touches."""
        return notebook.without_touches("pin", "upright")

    def summary(self, notebook: Notebook) -> str:
        """The length."""
        x, y, z = notebook.numbers("robot.tcp_offset_mm")
        return f"({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange"
