"""A force board on python-can's `virtual` bus, which ends within this process.

`virtual` only: it ends within this process. `udp_multicast` would leave the host by whichever network interface
the system picks, and whoever is on that network could feed forces to a rig.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

import can

from brushloop.drivers.force.rounds import Wrench
from brushloop.drivers.force.simulator import CanFrame, ForceBoard
from tests.drivers.failing import fail_rounds


class SimForceSensor:
    """A board that streams `force(t_s)` in a thread."""

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
        self.board = ForceBoard(force, noise_n=noise_n, noise_nm=noise_nm, seed=seed)
        self._period_s = 1.0 / rate_hz
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def commands(self) -> list[bytes]:
        """What was sent to the board, in order."""
        return self.board.commands

    @property
    def streaming(self) -> bool:
        """Whether the board was started."""
        return self.board.streaming

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

    def fail(self, *faults: str) -> None:
        """Let the next rounds meet these, one each."""
        fail_rounds(self.board, *faults)

    def _run(self, bus: can.BusABC) -> None:
        began_s = due_s = time.monotonic()
        try:
            while not self._stopping.is_set():
                if (message := bus.recv(max(0.0, due_s - time.monotonic()))) is not None:
                    if not message.is_extended_id:
                        self.board.obey(CanFrame(message.arbitration_id, bytes(message.data), message.is_error_frame))
                elif time.monotonic() >= due_s:
                    due_s = max(due_s + self._period_s, time.monotonic())
                    for frame in self.board.round(due_s - began_s):
                        bus.send(
                            can.Message(
                                arbitration_id=frame.can_id,
                                is_extended_id=frame.error,
                                is_error_frame=frame.error,
                                data=frame.data,
                            )
                        )
        finally:
            bus.shutdown()
