"""Faults of the loopback rig: what may go wrong, when it begins and how long it lasts.

Every server of the rig asks the board, before it answers, whether a fault strikes. What a run does about each fault in
each phase is in the table of tests/collect/faults/test_matrix.py.
"""

import asyncio
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.sim.brush.brush_file import complaint
from brushloop.drivers.sim.world import World

ON_PAPER_MM = 0.1
"""A tip that ends or rests no farther above than this counts as on the paper, which is taught with an error."""
ALL_BUT_THERE_MM = 0.1
"""Remaining descent that counts as pressed: a dwell is the very slow end of a descent."""
LIFT_MM = 10.0
"""Distance from the paper within which rising counts as lifting."""
HOME_MM = 1.0


class Phase(StrEnum):
    """What the arm is doing: the first of these that applies."""

    DIPPING = "dipping"
    """Over the well, and below its rim or on the way there."""
    PRESSED = "pressed"
    """On or below the paper plane, over the sheet: at rest, or in the last tenth of a millimetre of the way down."""
    DESCENDING = "descending"
    """Over the sheet, on a line down that ends on or below the paper plane."""
    LIFTING = "lifting"
    """Over the sheet, rising from the paper or from just above it."""
    TRAVELLING = "travelling"
    """Any other motion."""
    PARKED = "parked"
    """At rest where the tip was when the rig started, which is where its `rig.toml` parks it."""
    RESTING = "resting"
    """At rest anywhere else."""


ALWAYS = 1_000_000
"""A count that no session reaches."""


class Device(StrEnum):
    """The device that fails."""

    ROBOT = "robot"
    """The controller's JSON-RPC port."""
    TELEMETRY = "telemetry"
    """Its RTDE port."""
    CAMERA = "camera"
    INK = "ink"
    FORCE = "force"


REPLIES = frozenset({"mute", "late", "split", "duplicate", "wrong-id", "malformed", "garbage", "drop"})
"""The request is carried out; something is wrong with its reply."""
STOPS = {
    "protective-stop": SafetyMode.PROTECTIVE_STOP,
    "emergency-stop": SafetyMode.ROBOT_EMERGENCY_STOP,
    "safeguard-stop": SafetyMode.SAFEGUARD_STOP,
}
"""The cabinet stops the arm by itself; only a person ends that."""

KINDS: dict[Device, frozenset[str]] = {
    Device.ROBOT: frozenset({"deaf"}) | REPLIES | STOPS.keys(),
    Device.TELEMETRY: frozenset({"mute", "late"}),
    Device.CAMERA: frozenset({"black", "frozen", "torn"}),
    Device.INK: frozenset({"deaf", "mute", "garbage", "late", "unplug"}),
    Device.FORCE: frozenset({"silence", "no-second", "nan", "bus-error", "bus-off", "stuck"}),
}
"""What each kind does is in docs/loopback-controller.md."""


class Fault(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """One fault. All conditions of its trigger must hold at once; without any it begins at once.

    Once begun it strikes every matching request, push or frame until its `count` or `for_s` is over.
    """

    device: Device
    kind: str
    on: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.]{0,79}$")] | None = None
    """Only requests of this method: `moveLine`, or in full `rob1.MotionControl.moveLine`; `login` for the login."""
    nth: Annotated[int, Field(ge=1, le=ALWAYS)] = 1
    """Begins with the n-th request, push or frame for which all other conditions hold."""
    phase: Phase | None = None
    """Begins only while the arm is really doing this."""
    press: Annotated[int, Field(ge=0, le=ALWAYS)] | None = None
    """Begins only while this many presses are on the paper: from lifting off one to lifting off the next."""
    count: Annotated[int, Field(ge=1, le=ALWAYS)] | None = None
    """Largest number of strikes; without `for_s` 1 by default."""
    for_s: Annotated[float, Field(gt=0.0, le=86_400.0)] | None = None
    """Longest duration in real seconds from its beginning; the timeouts of drivers are in real time too."""
    late_s: Annotated[float, Field(ge=0.001, le=60.0)] = 0.3
    """How late a `late` reply or push of the robot comes, in real seconds."""

    @model_validator(mode="after")
    def _coherent(self) -> Self:
        kinds = KINDS[self.device]
        if self.kind not in kinds:
            raise ValueError(f"kind = {self.kind!r} is not one of {self.device}'s: {', '.join(sorted(kinds))}")
        if self.on is not None and self.device is not Device.ROBOT:
            raise ValueError(f"on = {self.on!r}: only the robot has methods")
        if self.by_itself and self.nth != 1:
            raise ValueError(f"nth = {self.nth} has no effect: {self.kind} of {self.device} does not wait for requests")
        return self

    @property
    def by_itself(self) -> bool:
        """True if it begins without a request."""
        return self.device is Device.INK or (self.kind in STOPS and self.on is None)


def fault_of(values: dict[str, Any]) -> Fault:
    """One fault from a client's request. Raises ValueError with one line that names the field."""
    try:
        return Fault.model_validate(values)
    except ValidationError as error:
        raise ValueError(complaint(error)) from None


TICK_S, IDLE_TICK_S = 0.002, 0.02


@dataclass(slots=True)
class Hung:
    """A fault on the board and its progress."""

    ident: int
    fault: Fault
    seen: int = 0
    """Requests that matched before it began."""
    struck: int = 0
    until_s: float | None = None
    """Real time at which `for_s` is over; None until it has begun."""

    def as_json(self) -> dict[str, Any]:
        """Its number, its fault without defaults, and how often it has struck."""
        fault = self.fault.model_dump(mode="json", exclude_defaults=True)
        return {"id": self.ident, "fault": fault, "struck": self.struck}


class FaultBoard:
    """Faults in the order in which they were added; of several that match one request the first strikes it."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._idents = itertools.count(1)
        self._hanging: dict[int, Hung] = {}
        self.strikes = 0
        """Of all faults so far."""

    def phase(self) -> Phase:
        """What the arm does now. Use it in the thread that owns the world."""
        world = self._world
        tip, to = world.tool(), world.target()
        x_mm, y_mm, depth_mm = world.on_sheet(tip)
        end_depth_mm = depth_mm if to is None else world.on_sheet(to)[2]
        over_sheet = world.is_over_sheet(x_mm, y_mm)
        if world.is_over_well(x_mm, y_mm) and max(depth_mm, end_depth_mm) > -world.config.table.well_depth_mm:
            return Phase.DIPPING
        if to is None:
            if over_sheet and depth_mm >= -ON_PAPER_MM:
                return Phase.PRESSED
            return Phase.PARKED if math.dist(tip.position_mm, world.config.home_mm) <= HOME_MM else Phase.RESTING
        if over_sheet and depth_mm > 0.0 and 0.0 <= end_depth_mm - depth_mm <= ALL_BUT_THERE_MM:
            return Phase.PRESSED
        if over_sheet and end_depth_mm > depth_mm and end_depth_mm >= -ON_PAPER_MM:
            return Phase.DESCENDING
        if over_sheet and end_depth_mm < depth_mm and depth_mm >= -LIFT_MM:
            return Phase.LIFTING
        return Phase.TRAVELLING

    def hang(self, fault: Fault) -> int:
        """Add a fault; return the number by which it can be removed."""
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
        now_s = self._world.clock.real_s()
        for hung in [*self._hanging.values()]:
            if hung.until_s is not None and now_s >= hung.until_s:
                self.take(hung.ident)
        return tuple(self._hanging.values())

    def meet(self, device: Device, op: str = "") -> Fault | None:
        """The fault that strikes this request, push, frame or round of a device; it counts as one strike."""
        for hung in self.hanging:
            fault = hung.fault
            waits = fault.on is not None and fault.on != op and not op.endswith(f".{fault.on}")
            if fault.device is not device or waits:
                continue
            if hung.until_s is None and not fault.by_itself and self._holds(fault):
                hung.seen += 1
                if hung.seen >= fault.nth:
                    self._begin(hung)
            if hung.until_s is not None:
                self._strike(hung)
                return fault
        return None

    def kind_met(self, device: Device) -> str | None:
        """The kind of the fault that strikes this request, frame or round of a device; None if none does."""
        fault = self.meet(device)
        return None if fault is None else fault.kind

    async def watch(self, stop: Callable[[SafetyMode], None]) -> None:
        """Begin faults that no request triggers, until cancelled; `stop` as for `begin_due`."""
        while True:
            self.begin_due(stop)
            await asyncio.sleep(TICK_S if self._hanging else IDLE_TICK_S)

    def begin_due(self, stop: Callable[[SafetyMode], None]) -> None:
        """Begin the faults that are due now without a request; `stop` gets the mode of a safety stop, over at once."""
        for hung in self.hanging:
            if hung.fault.by_itself and hung.until_s is None and self._holds(hung.fault):
                self._begin(hung)
                if hung.fault.kind in STOPS:
                    self._strike(hung)
                    self.take(hung.ident)
                    stop(STOPS[hung.fault.kind])

    def _begin(self, hung: Hung) -> None:
        hung.until_s = self._world.clock.real_s() + (hung.fault.for_s or math.inf)

    def _strike(self, hung: Hung) -> None:
        self.strikes += 1
        hung.struck += 1
        if hung.struck >= (hung.fault.count or (1 if hung.fault.for_s is None else ALWAYS)):
            self.take(hung.ident)

    def _holds(self, fault: Fault) -> bool:
        on_paper = fault.press is None or len(self._world.presses) == fault.press
        return on_paper and (fault.phase is None or self.phase() is fault.phase)
