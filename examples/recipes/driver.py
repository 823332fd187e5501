"""A driver: a syringe pump that takes `DOSE 0.500` as a line of text over TCP and answers `OK`.

An ink device is a table of `rig.toml` and a class with the methods of `Ink` in `drivers/devices.py`. Both go into a
file of `drivers/ink/`, the table also into `AnyInkTable` there. Write its simulator beside it, for real wire bytes.
"""
# ruff: noqa: D101, D102 - `Ink` says what each method does

from __future__ import annotations

import asyncio
from typing import Literal

from brushloop.drivers.devices import Identity, Well
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import DoseBudget, InkTable


class SyringeTable(InkTable, frozen=True):  # `port` is HOST:PORT
    kind: Literal["syringe"] = "syringe"
    dose_ml: float = 0.2

    def device(self, clock: Clock) -> SyringePump:
        return SyringePump(self, clock)


class SyringePump:
    def __init__(self, table: SyringeTable, clock: Clock) -> None:
        self._table, self._clock = table, clock
        self._budget = DoseBudget("ink", smallest_ml=0.01, max_dose_ml=2.0, max_per_minute_ml=50.0)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def connect(self) -> Identity:
        self._streams = await asyncio.open_connection(*self._table.port.split(":"))
        return Identity("ink", await self._ask("WHO"), "", simulated=False)

    async def dose(self, volume_ml: float) -> None:
        self._budget.take(volume_ml, self._clock.now_ns())
        if (answer := await self._ask(f"DOSE {volume_ml:.3f}")) != "OK":
            raise ProtocolViolation("ink", "dose", f"answered {answer!r}, expected 'OK'")

    async def replenish(self, dips: int) -> Well:
        await self.dose(self._table.dose_ml)
        return Well(level=None, dosed_ml=(dips + 1) * self._table.dose_ml)

    async def light(self) -> None:
        pass

    async def level(self) -> None:
        pass

    async def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()

    async def _ask(self, line: str) -> str:
        assert self._streams is not None
        reader, writer = self._streams
        writer.write(line.encode() + b"\n")
        return (await asyncio.wait_for(reader.readline(), 2.0)).decode("ascii").strip()
