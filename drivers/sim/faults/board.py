"""The board of faults: every server of the rig asks it, before it answers, whether a fault strikes."""

from __future__ import annotations

import itertools
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from brushloop.drivers.sim.faults.kinds import STOPS, Device, Fault
from brushloop.drivers.sim.faults.phases import Truth

KEPT = 100
"""Finished faults that are still listed."""
MOST = 1000
"""Most faults on the board at once."""


@dataclass(slots=True)
class Hung:
    """A fault on the board and its progress."""

    ident: int
    fault: Fault
    begun: bool = False
    seen: int = 0
    """Requests that matched before it began."""
    struck: int = 0
    until_s: float | None = None
    """Real time at which `for_s` is over; None before it begins."""


class FaultBoard:
    """Faults in the order in which they were added; of several that match one request the first strikes it.

    `hang`, `take`, `clear`, and `meet` for a fault of ink, may come from any thread; the rest belongs to the event loop
    of the rig.
    """

    def __init__(self, truth: Truth, real_s: Callable[[], float] = time.monotonic) -> None:
        self._truth = truth
        self._real_s = real_s
        self._idents = itertools.count(1)
        self._hanging: dict[int, Hung] = {}
        self.over: deque[Hung] = deque(maxlen=KEPT)
        """The newest finished faults."""

    def hang(self, fault: Fault) -> int:
        """Add a fault; return the number by which it can be removed. Raises ValueError above `MOST`."""
        if len(self._hanging) >= MOST:
            raise ValueError(f"there are already {MOST} faults on the board")
        hung = Hung(next(self._idents), fault)
        self._hanging[hung.ident] = hung
        return hung.ident

    def take(self, ident: int) -> bool:
        """Remove a fault; return False if none has that number."""
        return self._hanging.pop(ident, None) is not None

    def clear(self) -> int:
        """Remove all, those that have begun too; return how many there were."""
        count, self._hanging = len(self._hanging), {}
        return count

    @property
    def hanging(self) -> tuple[Hung, ...]:
        """Faults that are waiting or active."""
        self._expire()
        return tuple(self._hanging.values())

    @property
    def waits_by_itself(self) -> bool:
        """True while a fault waits that no request triggers: `due` must be polled."""
        return any(hung.fault.by_itself and not hung.begun for hung in tuple(self._hanging.values()))

    def meet(self, device: Device, op: str, kinds: frozenset[str]) -> Fault | None:
        """The fault, of these kinds, that strikes this request, push or frame; it counts as one strike."""
        for hung in self.hanging:
            fault = hung.fault
            if fault.device is device and fault.kind in kinds and self._strikes(hung, op):
                return fault
        return None

    def due(self) -> list[Fault]:
        """Begin the faults that are due now without a request; return the stops among them, which are finished."""
        stops: list[Fault] = []
        for hung in self.hanging:
            if hung.fault.by_itself and not hung.begun and self._holds(hung.fault):
                self._begin(hung)
                if hung.fault.kind in STOPS:
                    hung.struck = 1
                    self._end(hung)
                    stops.append(hung.fault)
        return stops

    def _strikes(self, hung: Hung, op: str) -> bool:
        fault = hung.fault
        if not fault.matches(op):
            return False
        if not hung.begun:
            if fault.by_itself or not self._holds(fault):
                return False
            hung.seen += 1
            if hung.seen < fault.nth:
                return False
            self._begin(hung)
        hung.struck += 1
        if fault.strikes is not None and hung.struck >= fault.strikes:
            self._end(hung)
        return True

    def _begin(self, hung: Hung) -> None:
        hung.begun = True
        if hung.fault.for_s is not None:
            hung.until_s = self._real_s() + hung.fault.for_s

    def _holds(self, fault: Fault) -> bool:
        truth = self._truth
        return (
            truth.now_s() >= fault.after_s
            and (fault.press is None or truth.presses == fault.press)
            and (fault.phase is None or truth.phase() is fault.phase)
        )

    def _expire(self) -> None:
        for hung in tuple(self._hanging.values()):
            if hung.until_s is not None and self._real_s() >= hung.until_s:
                self._end(hung)

    def _end(self, hung: Hung) -> None:
        if self.take(hung.ident):
            self.over.append(hung)
