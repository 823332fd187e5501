"""Step 8: the smallest box around what was taught, and cautious speeds, confirmed one by one."""

from __future__ import annotations

import asyncio

from brushloop.calibrate.files import read_gray
from brushloop.collect.errors import CannotTeach, ConfigError
from brushloop.collect.planning.limit_check import ask_reach
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.picture import draw_rig
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.jog import Point, hull
from brushloop.collect.teach.rig_text import rig_of
from brushloop.collect.teach.steps.places import sheet_corners, sheet_heights, tips
from brushloop.collect.teach.store import Notebook, StepName, Taught, Value, now_utc
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose

MARGIN_MM = 25.0
"""Room beside what was taught: a brush lifted along a tool axis that leans by 15 deg moves aside by as much."""
BELOW_MM = 2.0
"""Room below the deepest press and the dip, for a sheet that is found a little lower."""
DEFAULTS: tuple[tuple[str, float, str, float, str], ...] = (
    ("robot.limits.tilt_deg", 15.0, "deg", 30.0, "Widest lean of the brush"),
    ("robot.limits.speed_mm_s", 150.0, "mm/s", 500.0, "Highest speed of the tip in any motion"),
    ("robot.limits.acc_mm_s2", 800.0, "mm/s2", 5000.0, "Highest acceleration in any motion"),
    ("motion.travel_speed_mm_s", 100.0, "mm/s", 500.0, "Speed of travel above the sheet"),
    ("motion.press_speed_mm_s", 15.0, "mm/s", 100.0, "Speed down into a press"),
    ("motion.acc_mm_s2", 500.0, "mm/s2", 5000.0, "Acceleration of travel and press"),
)
"""Field, cautious default, unit, most that `rig.toml` takes, and what it is."""


class LimitsStep(Step):
    """Box, cone and speeds."""

    name: StepName = "limits"
    title = "Limits"
    minutes = 3
    needs: tuple[StepName, ...] = ("tip", "sheet", "places", "brush")

    async def teach(self, day: Day) -> None:
        """Show the box, have each limit confirmed, and ask the controller whether the arm reaches every corner."""
        found = self.derived(day.notebook)
        rig = rig_of(day.notebook.with_values(found), day.rig_path)
        picture = day.rig_path.with_name(f"{day.rig_path.stem}.limits.png")
        await day.working("drawing box and places")
        await asyncio.to_thread(draw_rig, rig, picture)
        await day.say(
            f"{picture} shows box, sheet, board, well and park from above.",
            picture=await asyncio.to_thread(read_gray, picture),
        )
        for axis, field in zip("xyz", _box_fields(), strict=True):
            taught = found[field]
            question = f"The box along base {axis}: {taught.value} {taught.unit} ({taught.how}; {field}). Agreed?"
            if not await day.yes(question):
                raise CannotTeach(
                    f"{field} was not agreed.",
                    "Teach the place again that makes the box too large: `brushloop rig teach`.",
                )
        for field, cautious, unit, most, what in DEFAULTS:
            if field not in day.notebook.values:
                value = await day.guide.number(f"{what} ({field})", unit, 1.0, most, cautious)
                how = "cautious default, agreed" if value == cautious else "typed"
                day.keep("limits", field, value, how, unit=unit)
        rig = rig_of(day.notebook.with_values(self.derived(day.notebook)), day.rig_path)
        try:
            count = await ask_reach(day.rig_path, rig, _to_reach(rig, day.notebook))
        except ConfigError as error:
            raise CannotTeach(
                f"the arm does not reach the whole sheet: {error.what}.",
                "Move the board with the sheet nearer to the arm, and teach sheet and places again.",
            ) from None
        await day.say(f"The controller finds joints for all {count} corners of the space above sheet and well.")

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """The box around what was taught, and the defaults that were not taught otherwise."""
        x_mm, y_mm, z_mm = hull(_within(notebook), MARGIN_MM)
        how = f"the smallest around sheet, well, wipe, pot and park position, and {MARGIN_MM:g} mm beside and above"
        floor = f"{BELOW_MM:g} mm below the deepest press and the dip; {MARGIN_MM:g} mm above travel and park"

        def taught(value: Value, unit: str, how: str) -> Taught:
            return Taught(value=value, unit=unit, how=how, at=now_utc(), step="limits")

        return {
            "robot.limits.x_mm": taught(list(x_mm), "mm", how),
            "robot.limits.y_mm": taught(list(y_mm), "mm", how),
            "robot.limits.z_mm": taught(list(z_mm), "mm", floor),
        } | {
            field: notebook.values.get(field) or taught(value, unit, "cautious default")
            for field, value, unit, _, _ in DEFAULTS
        }

    def forget(self, notebook: Notebook) -> Notebook:
        """Without the defaults."""
        return notebook.without(*(field for field, *_ in DEFAULTS))

    def summary(self, notebook: Notebook) -> str:
        """The box."""
        ranges = (notebook.numbers(field) for field in _box_fields())
        return " x ".join(f"{low:.0f}..{high:.0f}" for low, high in ranges) + " mm"


def _box_fields() -> tuple[str, ...]:
    return tuple(f"robot.limits.{axis}_mm" for axis in "xyz")


def _within(notebook: Notebook) -> list[Point]:
    """Everything that the tip must reach, in the base frame."""
    places, safe_mm = tips(notebook), notebook.number("motion.safe_z_mm")
    reached = [
        point for name, point in places.items() if name.split(" ")[0] in ("well-rim", "well", "wash-pot", "wash-rim")
    ]
    park_x, park_y, park_z = notebook.numbers("motion.park_mm")
    corners = sheet_corners(notebook)
    deepest_mm = min(sheet_heights(notebook)) - notebook.number("brush.max_depth_mm") - BELOW_MM
    x, y, _ = corners[0]
    dip_mm = notebook.number("ink.dip_z_mm") - BELOW_MM
    return [*reached, (park_x, park_y, park_z), *corners, (x, y, deepest_mm), (x, y, dip_mm), (x, y, safe_mm)]


def _to_reach(rig: RigConfig, notebook: Notebook) -> list[tuple[Pose, float, str]]:
    """Poses over and in the sheet's corners and the well, and the park position, upright and at the cone's edge."""
    yaw, speed, tilt = rig.paper.yaw_deg, rig.motion.press_speed_mm_s, rig.robot.limits.tilt_deg
    found: list[tuple[Pose, float, str]] = []
    for number, (x, y, z) in enumerate(sheet_corners(notebook), 1):
        found.append((brush_pose(x, y, rig.motion.safe_z_mm, heading_deg=yaw), speed, f"over corner {number}"))
        low_mm = z - rig.brush.max_depth_mm
        found.append((brush_pose(x, y, low_mm, heading_deg=yaw, tilt_deg=tilt), speed, f"pressed at corner {number}"))
    x, y, z = tips(notebook)["well 0"]
    found.append((brush_pose(x, y, z, heading_deg=yaw), speed, "in the well"))
    found.append((brush_pose(*rig.motion.park_mm, heading_deg=yaw), speed, "parked"))
    return found
