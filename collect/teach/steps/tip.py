"""Step 3: the tip of the brush. The same pin is touched from many sides; the program only reads."""

from __future__ import annotations

from brushloop.collect.errors import CannotTeach
from brushloop.collect.rig.check import brush_square
from brushloop.collect.teach.arm_reader import ArmReader
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.guide import Target
from brushloop.collect.teach.jog import touch
from brushloop.collect.teach.maths.tip import LEAST_TOUCHES, AxisFit, elsewhere, find_axis, find_tip
from brushloop.collect.teach.store import Notebook, StepName, Taught, now_utc
from brushloop.drivers.geometry import distance

MOST_TOUCHES = 24
GOOD_MM = 0.18
"""Root mean square error of the tip at which touching ends."""
WORST_MM = 0.35
"""Above this after the last touch, the tip is not accepted."""
UNKNOWN_MM = 20.0
"""Error above which no place of the tip is shown."""
LEAST_UPRIGHTS, UPRIGHTS, MOST_UPRIGHTS = 3, 12, 24
"""Times that the brush is held against a set square, each with another turn of the wrist. Twelve times, each accurate
to 0.15 deg, leave a standard error of 0.04 deg."""
WORST_DEG = 0.12
"""Standard error above which the direction counts as not measured. An upright brush bends along the heading only by the
few degrees of its set, so an error of 0.12 deg across the heading turns every mark by 5 deg, and it is judged bent."""
LEAST_TURN_DEG = 10.0
"""By less than this from hold to hold the wrist was not turned, and perhaps the arm was not even moved."""
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
            await self._uprights(day, reader)

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
            day.save(day.notebook.without_touches(f"pin {name}"))
            return False
        x, y, z = fit.offset_mm
        if fit.error_mm > UNKNOWN_MM:
            more = f"{len(touches)} touches do not give the tip yet; if Enter was pressed too early, the next"
            await day.say(f"{more} touches will show which one lies off.", tone="warning")
            return False
        await day.say(
            f"{len(touches)} touches: the tip is at ({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange, with a standard "
            f"error of {fit.error_mm:.3f} mm (goal: {GOOD_MM:g} mm); "
            f"no touch is more than {max(fit.residuals_mm):.2f} mm off."
        )
        return fit.error_mm <= GOOD_MM

    async def _uprights(self, day: Day, reader: ArmReader) -> None:
        """Have the brush held upright until its direction is known well enough. Raises `CannotTeach`."""
        while not await self._direction_known(day):
            free = (n for n in range(MOST_UPRIGHTS) if f"upright {n}" not in day.notebook.touches)
            if (index := next(free, None)) is None:
                with day.touched_again_if_refused("upright"):
                    raise CannotTeach(
                        f"after {MOST_UPRIGHTS} holds the direction of the brush is not known to {WORST_DEG:g} deg.",
                        "Hold the brush along a set square, not by eye; or skip the holds: it is then not measured.",
                    )
            how = (
                f"Upright {index + 1} of {UPRIGHTS}: the brush upright along the set square"
                f"{', the wrist turned differently than before' if index else ''}, anywhere over the table."
            )
            if await touch(day, reader, Target("upright", index, may_skip=True), how, f"upright {index}") is None:
                if measured_axis(day.notebook) is None:
                    await day.say("The direction of the brush is not measured.", tone="warning")
                return

    async def _direction_known(self, day: Day) -> bool:
        """Judge each hold by itself and by the others, name those that were not upright, and forget them."""
        holds = day.notebook.touched("upright")
        if not holds:
            return False
        *before, newest = holds
        flanges, axis = list(holds.values()), find_axis(list(holds.values()))
        names = [f"Hold {int(name) + 1}" for name in holds]
        square = brush_square(find_axis(flanges[-1:]).rotation_deg)
        if square.verdict == "contradicts":
            said = f"{names[-1]}: the brush would lean by {square.value} against the flange ({square.allowed})"
            wrong = {newest: f"{said}: it was not upright"}
        elif before and distance(flanges[-2], flanges[-1])[1] < LEAST_TURN_DEG:
            wrong = {newest: f"{names[-1]} is {names[-2].lower()} again: turn the wrist in between"}
        else:
            wrong = {list(holds)[k]: f"{names[k]} is {axis.off_deg[k]:.1f} deg from the others" for k in axis.strays}
            if wrong and not axis.clear:
                await day.say(*wrong.values(), "The next holds will show which were not upright.", tone="warning")
                return False
        if wrong:
            await day.say(*wrong.values(), "Left out, and asked for again.", tone="warning")
            day.save(day.notebook.without_touches(*(f"upright {name}" for name in wrong)))
            return False
        if len(holds) >= LEAST_UPRIGHTS:
            known = f"known to {axis.sigma_deg:.2f} deg (limit {WORST_DEG:g})"
            await day.say(f"{axis.holds} holds: the direction of the brush is {known}.")
        return axis.holds >= UPRIGHTS and axis.sigma_deg <= WORST_DEG

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
        if (axis := measured_axis(notebook)) is None:
            lean, how, sigma, known = (0.0, 0.0, 0.0), "taken as square to the flange", None, "not measured"
        else:
            lean, sigma = axis.rotation_deg, axis.sigma_deg
            how = f"held upright along a set square {axis.holds} times"
            known = f"leans by {axis.lean_deg:.2f} deg against the flange"
        return {
            "robot.tcp_offset_mm": offset,
            "robot.tcp_rotation_deg": Taught(
                value=list(lean), unit="deg", how=how, sigma=sigma, known=known, at=now, step="tip"
            ),
        }

    def forget(self, notebook: Notebook) -> Notebook:
        """Without the touches."""
        return notebook.without_touches("pin", "upright")

    def summary(self, notebook: Notebook) -> str:
        """The length."""
        x, y, z = notebook.numbers("robot.tcp_offset_mm")
        return f"({x:.2f}, {y:.2f}, {z:.2f}) mm from the flange"


def measured_axis(notebook: Notebook) -> AxisFit | None:
    """The direction of the brush; None where it was not held upright often or well enough to know it."""
    holds = list(notebook.touched("upright").values())
    axis = find_axis(holds) if holds else None
    return axis if axis is not None and axis.holds >= LEAST_UPRIGHTS and axis.sigma_deg <= WORST_DEG else None
