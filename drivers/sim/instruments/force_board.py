"""The SRI M8123B2 board itself: obeys start and stop, and makes rounds of frames; whoever has a bus carries them."""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

from drivers.force.rounds import COMMAND_ID, START, STOP, encode_round
from drivers.force.samples import Wrench
from drivers.force.stream import BUS_OFF

BUS_ERROR = 0x04
"""Class of an error frame: the controller has a problem but is on the bus."""


class Fault(StrEnum):
    """What happens to one round."""

    SILENCE = "the round is left out"
    NO_FIRST = "0x291 is missing"
    NO_SECOND = "0x292 is missing"
    NO_THIRD = "0x293 is missing"
    SHORT = "0x292 carries four bytes"
    NAN = "Fz is not a number"
    INF = "Mx is infinite"
    BUS_ERROR = "an error frame comes in between"
    BUS_OFF = "the bus goes off"
    STUCK = "the round is the one before once more"


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One frame on the bus, 11-bit id; an error frame where `error` is set."""

    can_id: int
    data: bytes
    error: bool = False


class ForceBoard:
    """Measures `force(t_s)` with seeded noise, from the start command to the stop command."""

    def __init__(
        self, force: Callable[[float], Wrench], *, noise_n: float = 0.0, noise_nm: float = 0.0, seed: int = 1
    ) -> None:
        self.commands: list[bytes] = []
        """What was sent to the board, in order."""
        self.streaming = False
        self._force = force
        self._noise = (noise_n,) * 3 + (noise_nm,) * 3
        self._random = random.Random(seed)
        self._faults: deque[Fault] = deque()
        self._before: Wrench | None = None

    def fail(self, *faults: Fault) -> None:
        """Let the next rounds meet these, one each."""
        self._faults.extend(faults)

    def obey(self, frame: CanFrame) -> None:
        """Take one frame from the bus; what is no command is not for the board."""
        if frame.can_id == COMMAND_ID and not frame.error:
            self.commands.append(frame.data)
            if frame.data in (START, STOP):
                self.streaming = frame.data == START

    def round(self, t_s: float) -> Iterator[CanFrame]:
        """The frames of the round that is due at `t_s`; none while the board is stopped."""
        if not self.streaming:
            return
        fault = self._faults.popleft() if self._faults else None
        if fault is Fault.SILENCE:
            return
        if fault in (Fault.BUS_OFF, Fault.BUS_ERROR):
            self.streaming = fault is not Fault.BUS_OFF
            yield CanFrame(BUS_OFF if fault is Fault.BUS_OFF else BUS_ERROR, bytes(8), error=True)
            return
        values = self._force(t_s)
        fx, fy, fz, mx, my, mz = (v + self._random.gauss(0.0, s) for v, s in zip(values, self._noise, strict=True))
        if fault is Fault.STUCK and self._before is not None:
            fx, fy, fz, mx, my, mz = self._before
        self._before = (fx, fy, fz, mx, my, mz)
        wrench = (fx, fy, math.nan if fault is Fault.NAN else fz, math.inf if fault is Fault.INF else mx, my, mz)
        left_out = {Fault.NO_FIRST: 0, Fault.NO_SECOND: 1, Fault.NO_THIRD: 2}
        for place, (can_id, data) in enumerate(encode_round(wrench)):
            if fault is None or left_out.get(fault) != place:
                yield CanFrame(can_id, data[:4] if fault is Fault.SHORT and place == 1 else data)
