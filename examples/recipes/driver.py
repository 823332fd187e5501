"""A driver: a syringe pump that takes `DOSE 0.500` as a line of text over TCP and answers `OK`.

A driver is a class that has the methods of its protocol in `drivers/devices.py` (here `Ink`). It goes into
`drivers/ink/`, its options into the union of ink devices in `collect/rig/config_devices.py`, and its construction into
`make_ink` in `collect/rig/devices.py`. Write its simulator beside it in the same go: real wire
bytes from both sides are what the tests of the driver, of the faults and of the whole rig run on.
"""

from __future__ import annotations

import asyncio

from brushloop.drivers.devices import Identity
from brushloop.drivers.errors import DeviceTimeout, NotConnected, ProtocolViolation
from brushloop.drivers.host import Clock
from brushloop.drivers.ink.port import DoseBudget


class SyringePump:
    """Doses ink; has neither a light nor a gauge."""

    def __init__(self, host: str, port: int, clock: Clock, *, timeout_s: float = 2.0) -> None:
        self._host, self._port, self._clock, self._timeout_s = host, port, clock, timeout_s
        self._budget = DoseBudget("ink", smallest_ml=0.01, max_dose_ml=2.0, max_per_minute_ml=5.0)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def connect(self) -> Identity:
        """Open the connection and make sure that the right device answers; gives no ink."""
        self._streams = await asyncio.wait_for(asyncio.open_connection(self._host, self._port), self._timeout_s)
        return Identity("ink", await self._ask("WHO"), "", simulated=False)

    async def dose(self, volume_ml: float) -> None:
        """Add ink to the well. Raises `LimitExceeded` before anything is sent."""
        self._budget.take(volume_ml, self._clock.now_ns())
        if (answer := await self._ask(f"DOSE {volume_ml:.3f}")) != "OK":
            raise ProtocolViolation("ink", "dose", f"answered {answer!r}, expected 'OK'")

    async def light(self, level: float) -> bool:
        """Report that there is no light."""
        return False

    async def level(self) -> float | None:
        """Report that there is no gauge."""
        return None

    async def close(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()
            await self._streams[1].wait_closed()

    async def _ask(self, line: str) -> str:
        if self._streams is None:
            raise NotConnected("ink", line, "not connected")
        reader, writer = self._streams
        writer.write(line.encode() + b"\n")
        try:
            return (await asyncio.wait_for(reader.readline(), self._timeout_s)).decode("ascii").strip()
        except TimeoutError:
            raise DeviceTimeout("ink", line, f"no reply in {self._timeout_s:g} s") from None
