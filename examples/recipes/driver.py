"""A driver: a syringe pump that takes `DOSE 0.500` as a line of text over TCP and answers `OK`.

An ink device is a table of `rig.toml` and an `InkDevice`, which has what all of them share. Both go into a file of
`drivers/ink/`, the table also into `AnyInkTable` there. Write its simulator beside it, for real wire bytes.
"""
# ruff: noqa: D101, D102 - `InkDevice` says what each method does

from __future__ import annotations

import asyncio
from typing import Literal

from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import InkDevice, InkTable


class SyringeTable(InkTable, frozen=True):  # `port` is HOST:PORT
    kind: Literal["syringe"] = "syringe"
    dose_ml: float = 0.2
    max_per_minute_ml: float = 50.0

    def device(self, clock: Clock) -> SyringePump:
        return SyringePump(self, clock)


class SyringePump(InkDevice):
    def __init__(self, table: SyringeTable, clock: Clock) -> None:
        super().__init__("ink", table, clock, smallest_ml=0.01)
        self._address = table.port.split(":")
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def connect(self) -> Identity:
        self._streams = await asyncio.open_connection(*self._address)
        return Identity(await self._ask("WHO"), "", simulated=False)

    async def _give(self, volume_ml: float) -> None:
        if (answer := await self._ask(f"DOSE {volume_ml:.3f}")) != "OK":
            raise ProtocolViolation("ink", "dose", f"answered {answer!r}, expected 'OK'")

    async def replenish(self) -> None:
        await self.dose(self._table.dose_ml)

    async def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()

    async def _ask(self, line: str) -> str:
        assert self._streams is not None
        reader, writer = self._streams
        writer.write(line.encode() + b"\n")
        return (await asyncio.wait_for(reader.readline(), 2.0)).decode("ascii").strip()
