"""Step 6: the brush by calipers, and what keeps the well filled."""

from __future__ import annotations

from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Choice
from brushloop.collect.rig.check import Check, brush_shorter_than_tool, deepest_press
from brushloop.collect.teach.day import Asked, Day, Step
from brushloop.collect.teach.store import Notebook
from brushloop.drivers.ink.port import InkTable
from brushloop.drivers.ink.pump import ModbusPumpConfig
from brushloop.drivers.ink.station import InkStationConfig

DEEPEST_SHARE = 0.45
"""A bundle that is pressed deeper than this share of its length comes near to its ferrule."""
PRIME_ML = 0.5
NONE, STATION, PUMP = Choice("n", "nothing: by hand"), Choice("i", "an ink station"), Choice("p", "a Modbus pump")
CALIPERS = "measured with calipers and typed"


def _hair(notebook: Notebook, length_mm: float) -> Check:
    x, y, z = notebook.numbers("robot.tcp_offset_mm")
    return brush_shorter_than_tool((x, y, z), length_mm)


BRUSH = (
    Asked(
        "brush.radius_mm",
        "R: radius of the wet bundle at the ferrule, by calipers",
        "mm",
        0.5,
        50.0,
        CALIPERS,
        sigma=0.1,
    ),
    Asked(
        "brush.length_mm",
        "L: length of the hair from the ferrule to the tip, by calipers",
        "mm",
        3.0,
        200.0,
        CALIPERS,
        sigma=0.5,
        check=_hair,
    ),
    Asked(
        "brush.max_depth_mm",
        "Deepest press that this brush can take",
        "mm",
        1.0,
        100.0,
        f"agreed; {DEEPEST_SHARE:.0%} of L is cautious",
        default=lambda book: f"{int(DEEPEST_SHARE * book.number('brush.length_mm'))}",
        check=lambda book, depth_mm: deepest_press(depth_mm, book.number("brush.length_mm")),
    ),
    Asked("brush.name", "Name of the brush, for the record", default="brush"),
    Asked("aside.ink", "What keeps the ink well filled?", choices=(NONE, STATION, PUMP)),
)
PORT = Asked("ink.device.port", "Its serial line, such as /dev/serial/by-id/usb-…")
DELIVERY = Asked(
    "ink.device.ml_per_revolution",
    "Delivery per revolution, by weighing ten of them",
    "ml",
    0.001,
    10.0,
    "weighed and typed",
)


class BrushStep(Step):
    """R, L, deepest press; the ink device."""

    name = "brush"
    title = "Brush and ink"
    minutes = 4
    needs = ("tip", "places")
    observes = ("brush.", "ink.device.", "ink.name", "aside.ink")

    async def teach(self, day: Day) -> None:
        """Ask for what calipers say, and find the device at the well. Raises `CannotTeach`, `DeviceError`."""
        await day.values("brush", *BRUSH)
        kind = day.notebook.get("aside.ink")
        if kind != NONE.key and "ink.device.kind" not in day.notebook.values:
            await day.values("brush", PORT)
            if not (port := str(day.notebook.get(PORT.field))):
                day.save(day.notebook.without(PORT.field))
                remedy = "Type its path; `ls -l /dev/serial/by-id /dev/tty*` lists what there is."
                raise CannotTeach("no serial line was named.", remedy)
            device: InkTable = InkStationConfig(kind="ink-station", port=port)
            if kind == PUMP.key:
                await day.values("brush", DELIVERY)
                ml = day.notebook.number(DELIVERY.field)
                device = ModbusPumpConfig(kind="modbus-pump", port=port, ml_per_revolution=ml)
            await self._primed(day, device)
            day.keep("brush", "ink.device.kind", device.kind, "answered on its line")
        await day.values("brush", Asked("ink.name", "Name of the ink, for the record", default="ink"))

    async def _primed(self, day: Day, config: InkTable) -> None:
        await day.working(f"asking {config.port} who it is")
        device = config.device(day.clock)
        try:
            identity = await device.connect()
            level = await device.level()
            gauge = "no gauge" if level is None else f"well {level:.0%} full"
            await day.say(f"{identity.model} {identity.firmware}: {gauge}")
            while await day.yes(f"Give {PRIME_ML:g} ml, to fill its tube? The well must stand under it."):
                await day.working(f"giving {PRIME_ML:g} ml")
                await device.dose(min(PRIME_ML, config.dose_ml))
                level = await device.level()
                if level is not None:
                    await day.say(f"well {level:.0%} full")
        finally:
            await device.close()

    def summary(self, notebook: Notebook) -> str:
        """R, L and the deepest press."""
        radius, length, deepest = (notebook.number(f"brush.{name}_mm") for name in ("radius", "length", "max_depth"))
        return f"R {radius:g}, L {length:g}, deepest press {deepest:g} mm"
