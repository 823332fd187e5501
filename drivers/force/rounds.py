"""The frames of a Sunrise SRI M8123B2 board: three per round, two float32 each, low byte first.

| id | direction | bytes |
|---|---|---|
| 0x080 | to the board | 02 starts the stream, 00 stops it |
| 0x291 | from the board | Fx, Fy in N |
| 0x292 | from the board | Fz in N, Mx in Nm |
| 0x293 | from the board | My, Mz in Nm |

The frames carry no counter: only their order and timing show which three belong together.
"""

from __future__ import annotations

import struct

Wrench = tuple[float, float, float, float, float, float]
"""Fx, Fy, Fz in N and Mx, My, Mz in Nm, in the sensor's frame."""

LOOPBACK_CHANNEL = "loopback-force-board"
"""The loopback rig's bus on a socketcand gateway. Longer than the 15 characters that a network interface's name may
have, so no gateway to a real bus can serve it."""

COMMAND_ID = 0x080
START = b"\x02"
STOP = b"\x00"
FIRST_ID = 0x291
BITRATE = 1_000_000
BUS_OFF = 0x40
"""Bit of an error frame's id (Linux `can/error.h`): the controller took itself off the bus."""
_PAIR = struct.Struct("<2f")


def encode_round(wrench: Wrench) -> tuple[tuple[int, bytes], ...]:
    """The three frames of a round, as (id, bytes)."""
    return tuple((FIRST_ID + place, _PAIR.pack(*wrench[2 * place : 2 * place + 2])) for place in range(3))


class RoundAssembler:
    """Turns frames into wrenches; incomplete and implausible rounds are dropped and counted."""

    def __init__(self, *, round_ms: float, max_n: float, max_nm: float) -> None:
        self._round_s = round_ms / 1e3
        self._limits = (max_n,) * 3 + (max_nm,) * 3
        self._values: list[float] = []
        self._began_s: float | None = None
        self._last_place = -1
        self._spoiled = True  # until a round begins; joining in mid-round is not a fault
        self.torn = 0
        self.refused = 0

    def feed(self, can_id: int, data: bytes, at_s: float) -> Wrench | None:
        """Take a frame received at `at_s`; return the wrench that it completes, else None."""
        place = can_id - FIRST_ID
        if not 0 <= place < 3:
            return None
        late = self._began_s is not None and not abs(at_s - self._began_s) <= self._round_s
        if place == 0 or place <= self._last_place or late:  # a new round, even if its first frame was lost
            if self._values:
                self._tear()
            self._began_s, self._spoiled = at_s, False
        self._last_place = place
        if self._spoiled:
            return None
        if len(self._values) != 2 * place or len(data) != _PAIR.size:
            self._tear()
            self._spoiled = True
            return None
        self._values += _PAIR.unpack(data)
        if place < 2:
            return None
        fx, fy, fz, mx, my, mz = self._values
        self._values = []
        wrench = (fx, fy, fz, mx, my, mz)
        # Written so that NaN fails the check.
        if not all(abs(value) <= limit for value, limit in zip(wrench, self._limits, strict=True)):
            self.refused += 1
            return None
        return wrench

    def _tear(self) -> None:
        self.torn += 1
        self._values = []
