"""What a force sensor hands over."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.samples import Stamp

Wrench = tuple[float, float, float, float, float, float]
"""Fx, Fy, Fz in N and Mx, My, Mz in Nm, in the sensor's frame."""

LOOPBACK_CHANNEL = "loopback-force-board"
"""The loopback rig's bus on a socketcand gateway. Longer than the 15 characters that a network interface's name may
have, so no gateway to a real bus can serve it."""


@dataclass(frozen=True, slots=True)
class ForceSample:
    """Force in N and torque in Nm in the sensor's frame, less the bias; `stamp.device_ns` is the CAN adapter's time."""

    stamp: Stamp
    force_n: tuple[float, float, float]
    torque_nm: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ForceHealth:
    """How the stream has been since `connect`."""

    rate_hz: float
    """Measured over the newest rounds; 0 before the second."""
    rounds: int
    torn: int
    """Rounds of which a frame was missing, late or malformed; dropped."""
    refused: int
    """Whole rounds with NaN, inf or more than the sensor's range; dropped."""
    gaps: int
    """Pauses between good rounds longer than `gap_ms`."""
    bus_errors: int
