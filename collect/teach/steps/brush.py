"""Step 6: the brush by calipers, and what keeps the well filled."""

from __future__ import annotations

from brushloop.collect.errors import CannotTeach
from brushloop.collect.operator import Choice
from brushloop.collect.rig.check import brush_shorter_than_tool, deepest_press
from brushloop.collect.rig.config_devices import InkDeviceConfig, InkStationConfig, ModbusPumpConfig
from brushloop.collect.rig.devices import make_ink
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.store import Notebook, StepName
from brushloop.drivers.host import Clock

DEEPEST_SHARE = 0.45
"""A bundle that is pressed deeper than this share of its length comes near to its ferrule."""
PRIME_ML = 0.5
NONE, STATION, PUMP = Choice("n", "nothing: by hand"), Choice("i", "an ink station"), Choice("p", "a Modbus pump")


class BrushStep(Step):
    """R, L, deepest press; the ink device."""

    name: StepName = "brush"
    title = "Brush and ink"
    minutes = 4
    needs: tuple[StepName, ...] = ("tip", "places")

    async def teach(self, day: Day) -> None:
        """Ask for what calipers say, and find the device at the well. Raises `CannotTeach`, `DeviceError`."""
        if "brush.max_depth_mm" not in day.notebook.values:
            await self._brush(day)
        if "aside.ink" not in day.notebook.values:
            await self._ink(day)

    async def _brush(self, day: Day) -> None:
        ask, calipers = day.guide.number, "measured with calipers and typed"
        radius_mm = await ask("R: radius of the wet bundle at the ferrule, by calipers", "mm", 0.5, 50.0, None)
        length_mm = await ask("L: length of the hair from the ferrule to the tip, by calipers", "mm", 3.0, 200.0, None)
        hair = brush_shorter_than_tool(_tool(day.notebook), length_mm)
        if hair.verdict == "contradicts":
            raise CannotTeach(f"L = {length_mm:g} mm cannot be ({hair.allowed}).", hair.remedy)
        deepest_mm = await ask(
            "Deepest press that this brush can take", "mm", 1.0, 100.0, float(int(DEEPEST_SHARE * length_mm))
        )
        check = deepest_press(deepest_mm, length_mm)
        if check.verdict == "contradicts":
            raise CannotTeach(f"a press {deepest_mm:g} mm deep cannot be ({check.allowed}).", check.remedy)
        name = await day.guide.text("Name of the brush, for the record", "brush")
        with day.together():
            day.keep("brush", "brush.name", name, "typed")
            day.keep("brush", "brush.radius_mm", radius_mm, calipers, unit="mm", sigma=0.1)
            day.keep("brush", "brush.length_mm", length_mm, calipers, unit="mm", sigma=0.5)
            day.keep(
                "brush", "brush.max_depth_mm", deepest_mm, f"agreed; {DEEPEST_SHARE:.0%} of L is cautious", unit="mm"
            )

    async def _ink(self, day: Day) -> None:
        kind = await day.guide.choose("What keeps the ink well filled?", (NONE, STATION, PUMP), "")
        config: InkDeviceConfig | None = None
        if kind != NONE.key:
            port = (await day.guide.text("Its serial line, such as /dev/serial/by-id/usb-…", "")).strip()
            if not port:
                remedy = "Type its path; `ls -l /dev/serial/by-id /dev/tty*` lists what there is."
                raise CannotTeach("no serial line was named.", remedy)
            config = await self._device(day, kind, port)
        name = await day.guide.text("Name of the ink, for the record", "ink")
        with day.together():
            if config is not None:
                self._keep_device(day, config)
            day.keep("brush", "ink.name", name, "typed")
            day.keep("brush", "aside.ink", kind, "answered")

    async def _device(self, day: Day, kind: str, port: str) -> InkDeviceConfig:
        config: InkDeviceConfig
        if kind == STATION.key:
            config = InkStationConfig(kind="ink-station", port=port)
        else:
            question = "Delivery per revolution, by weighing ten of them"
            ml = await day.guide.number(question, "ml", 0.001, 10.0, None)
            config = ModbusPumpConfig(kind="modbus-pump", port=port, ml_per_revolution=ml)
        await self._primed(day, config, day.clock)
        return config

    def _keep_device(self, day: Day, config: InkDeviceConfig) -> None:
        day.keep("brush", "ink.device.kind", config.kind, "answered on its line")
        day.keep("brush", "ink.device.port", config.port, "typed, and answered")
        if isinstance(config, ModbusPumpConfig):
            how = "weighed and typed"
            day.keep("brush", "ink.device.ml_per_revolution", config.ml_per_revolution, how, unit="ml")

    async def _primed(self, day: Day, config: InkDeviceConfig, clock: Clock) -> None:
        await day.working(f"asking {config.port} who it is")
        device = make_ink(config, clock)
        try:
            identity = await device.connect()
            level = await device.level()
            gauge = "no gauge" if level is None else f"well {level:.0%} full"
            await day.say(f"{identity.model} {identity.firmware}: {gauge}")
            while await day.yes(f"Give {PRIME_ML:g} ml, to fill its tube? The well must stand under it."):
                day.guide.settle()
                await day.working(f"giving {PRIME_ML:g} ml")
                await device.dose(min(PRIME_ML, config.dose_ml))
                level = await device.level()
                if level is not None:
                    await day.say(f"well {level:.0%} full")
        finally:
            await device.close()

    def forget(self, notebook: Notebook) -> Notebook:
        """Without brush and ink device; where the well stands is another step's."""
        return notebook.without("brush.", "ink.device.", "ink.name", "aside.ink")

    def summary(self, notebook: Notebook) -> str:
        """R, L and the deepest press."""
        radius, length, deepest = (notebook.number(f"brush.{name}_mm") for name in ("radius", "length", "max_depth"))
        return f"R {radius:g}, L {length:g}, deepest press {deepest:g} mm"


def _tool(notebook: Notebook) -> tuple[float, float, float]:
    x, y, z = notebook.numbers("robot.tcp_offset_mm")
    return x, y, z
