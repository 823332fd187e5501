"""An SRI M8123B2 board on python-can's `virtual` bus.

`virtual` only: it ends within this process. `udp_multicast` would leave the host by whichever network interface
the system picks, and whoever is on that network could feed forces to a rig.
"""

from __future__ import annotations

import math
import random
import threading
import time
from collections import deque
from collections.abc import Callable
from enum import StrEnum
from types import TracebackType
from typing import Self

import can

from drivers.force.rounds import COMMAND_ID, START, STOP, encode_round
from drivers.force.samples import Wrench
from drivers.force.stream import BUS_OFF


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


class SimForceSensor:
    """Streams `force(t_s)` with seeded noise from the start command to the stop command, in a thread."""

    def __init__(
        self,
        channel: str,
        force: Callable[[float], Wrench],
        *,
        rate_hz: float = 200.0,
        noise_n: float = 0.0,
        noise_nm: float = 0.0,
        seed: int = 1,
    ) -> None:
        self.channel = channel
        self.commands: list[bytes] = []
        """What was sent to the board, in order."""
        self.streaming = False
        self._force = force
        self._period_s = 1.0 / rate_hz
        self._noise = (noise_n,) * 3 + (noise_nm,) * 3
        self._random = random.Random(seed)
        self._faults: deque[Fault] = deque()
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Join the bus."""
        bus = can.Bus(self.channel, "virtual", ignore_config=True)
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, args=(bus,), name="sim force sensor", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Leave the bus."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()

    def fail(self, *faults: Fault) -> None:
        """Let the next rounds meet these, one each."""
        self._faults.extend(faults)

    def _run(self, bus: can.BusABC) -> None:
        began_s = due_s = time.monotonic()
        try:
            while not self._stopping.is_set():
                if (message := bus.recv(max(0.0, due_s - time.monotonic()))) is not None:
                    self._obey(message)
                elif time.monotonic() >= due_s:
                    due_s = max(due_s + self._period_s, time.monotonic())
                    if self.streaming:
                        self._send_round(bus, due_s - began_s)
        finally:
            bus.shutdown()

    def _obey(self, message: can.Message) -> None:
        if message.arbitration_id == COMMAND_ID and not message.is_extended_id:
            data = bytes(message.data)
            self.commands.append(data)
            if data in (START, STOP):
                self.streaming = data == START

    def _send_round(self, bus: can.BusABC, t_s: float) -> None:
        fault = self._faults.popleft() if self._faults else None
        if fault is Fault.SILENCE:
            return
        if fault in (Fault.BUS_OFF, Fault.BUS_ERROR):
            error_class = BUS_OFF if fault is Fault.BUS_OFF else 0x04
            bus.send(can.Message(arbitration_id=error_class, is_error_frame=True, data=bytes(8)))
            self.streaming = self.streaming and fault is not Fault.BUS_OFF
            return
        values = self._force(t_s)
        fx, fy, fz, mx, my, mz = (v + self._random.gauss(0.0, s) for v, s in zip(values, self._noise, strict=True))
        wrench = (fx, fy, math.nan if fault is Fault.NAN else fz, math.inf if fault is Fault.INF else mx, my, mz)
        left_out = {Fault.NO_FIRST: 0, Fault.NO_SECOND: 1, Fault.NO_THIRD: 2}
        for place, (can_id, data) in enumerate(encode_round(wrench)):
            if fault is not None and left_out.get(fault) == place:
                continue
            payload = data[:4] if fault is Fault.SHORT and place == 1 else data
            bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=payload))
