"""Kinds of faults: one entry says what breaks, how, when it begins and how long it lasts."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError, model_validator

from brushloop.drivers.sim.described import complaint
from brushloop.drivers.sim.faults.phases import Phase

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


class InkFault(StrEnum):
    """What happens to one request to the ink device, and to its reply."""

    DEAF = "deaf"
    """The request is lost: not carried out, not answered."""
    MUTE = "mute"
    """Carried out, but the reply is lost."""
    GARBAGE = "garbage"
    """Carried out, but noise comes instead of the reply."""
    LATE = "late"
    """Carried out, and the reply comes later."""
    SPLIT = "split"
    """The reply comes byte by byte."""
    DAMAGED = "damaged"
    """The reply has a wrong checksum."""
    MISTAKEN = "mistaken"
    """A valid reply to another request."""
    ECHO = "echo"
    """Only an echo of the request comes back."""
    UNPLUG = "unplug"
    """The port disappears."""


class ForceFault(StrEnum):
    """What happens to one round of the force board."""

    SILENCE = "silence"
    """The round is left out."""
    NO_FIRST = "no-first"
    """Frame 0x291 is missing."""
    NO_SECOND = "no-second"
    """Frame 0x292 is missing."""
    NO_THIRD = "no-third"
    """Frame 0x293 is missing."""
    SHORT = "short"
    """Frame 0x292 carries four bytes."""
    NAN = "nan"
    """Fz is not a number."""
    INF = "inf"
    """Mx is infinite."""
    BUS_ERROR = "bus-error"
    """An error frame comes instead."""
    BUS_OFF = "bus-off"
    """The bus goes off."""
    STUCK = "stuck"
    """The previous round is repeated."""


LOST = frozenset({"deaf"})
"""The request never arrives: it is neither carried out nor answered."""
REPLIES = frozenset({"mute", "late", "split", "duplicate", "wrong-id", "malformed", "garbage", "drop"})
"""The request is carried out; something is wrong with its reply."""
STOPS = frozenset({"protective-stop", "emergency-stop", "safeguard-stop"})
"""The cabinet stops the arm by itself; only a person ends that."""

KINDS: dict[Device, frozenset[str]] = {
    Device.ROBOT: LOST | REPLIES | STOPS,
    Device.TELEMETRY: frozenset({"mute", "late", "malformed", "drop"}),
    Device.CAMERA: frozenset({"stale", "black", "frozen", "torn", "drop"}),
    Device.INK: frozenset(kind.value for kind in InkFault),
    Device.FORCE: frozenset(kind.value for kind in ForceFault),
}


class Fault(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """One fault. All conditions of its trigger must hold at once; without any it begins at once.

    Once begun it strikes every matching request, push or frame until its `count` or `for_s` is over.
    """

    device: Device
    kind: str
    after_s: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    """Earliest beginning, in simulated seconds since the rig started."""
    on: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_.]{0,79}$")] | None = None
    """Only requests of this method: `moveLine`, or in full `rob1.MotionControl.moveLine`; `login` for the login."""
    nth: Annotated[int, Field(ge=1, le=ALWAYS)] = 1
    """Begins with the n-th request, push or frame for which all other conditions hold."""
    phase: Phase | None = None
    """Begins only while the arm is really doing this."""
    press: Annotated[int, Field(ge=0, le=ALWAYS)] | None = None
    """Begins only while this many presses are on the paper: from lifting off one to lifting off the next."""
    count: Annotated[int, Field(ge=1, le=ALWAYS)] | None = None
    """Number of strikes; 1 where neither this nor `for_s` is given."""
    for_s: Annotated[float, Field(gt=0.0, le=86_400.0)] | None = None
    """Duration in real seconds from its beginning; the timeouts of drivers are in real time too."""
    late_s: Annotated[float, Field(ge=0.001, le=60.0)] = 0.3
    """How late a `late` reply or push of the robot comes, in real seconds."""

    @model_validator(mode="after")
    def _coherent(self) -> Fault:
        kinds = KINDS[self.device]
        if self.kind not in kinds:
            raise ValueError(f"kind = {self.kind!r} is not one of {self.device}'s: {', '.join(sorted(kinds))}")
        if self.count is not None and self.for_s is not None:
            raise ValueError("count and for_s exclude each other")
        if self.on is not None and self.device is not Device.ROBOT:
            raise ValueError(f"on = {self.on!r}: only the robot has methods")
        if self.kind in STOPS and (self.for_s is not None or self.count not in (None, 1)):
            raise ValueError(f"{self.kind} happens once and lasts until a person ends it: no count, no for_s")
        if self.by_itself and self.nth != 1:
            raise ValueError(f"nth = {self.nth} counts nothing here: {self.kind} of {self.device} waits for no request")
        if "late_s" in self.model_fields_set and (self.kind != "late" or self.device is Device.INK):
            raise ValueError("late_s goes with kind = 'late' of robot and telemetry only")
        return self

    @property
    def by_itself(self) -> bool:
        """True if it begins without a request."""
        return self.device is Device.INK or (self.kind in STOPS and self.on is None)

    @property
    def strikes(self) -> int | None:
        """Number of strikes; None where `for_s` ends it."""
        return None if self.for_s is not None else self.count or 1

    def matches(self, op: str) -> bool:
        """Whether the fault waits for `op`, a method's full name."""
        return self.on is None or op == self.on or op.endswith(f".{self.on}")


def fault_of(values: dict[str, Any]) -> Fault:
    """One fault from a client's request. Raises ValueError with one line that names the field."""
    try:
        return Fault.model_validate(values)
    except ValidationError as error:
        field, what = complaint(error)
        raise ValueError(f"{field}: {what}" if field else what) from None
