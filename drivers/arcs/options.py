"""How an arm under ARCS is reached and set up."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.arcs.rpc import Framing


@dataclass(frozen=True, slots=True)
class ArcsOptions:
    """Where the controller is and how the arm is set up."""

    host: str
    port: int = 30004
    tcp_offset_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Flange to brush tip."""
    position_tolerance_mm: float = 0.05
    rotation_tolerance_deg: float = 0.1
    poll_s: float = 0.02
    telemetry_hz: float = 100.0
    stale_after_ms: float = 500.0
    power_timeout_s: float = 60.0
    stop_acc_m_s2: float = 2.0
    framing: Framing = "sof"
    """`sof` as the maker's client speaks, `bare` as the maker documents; a cabinet may well take only one of them."""
    rtde_port: int | None = None
    """Where poses are pushed from, 30010 on a cabinet; None polls for them."""
    payload_kg: float | None = None
    """Mass at the flange; None leaves what is set on the pendant, as with the three below."""
    payload_cog_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of that mass, from the flange."""
    collision_level: int | None = None
    """0 is off, 9 is the most sensitive."""
    speed_fraction: float | None = None
    """Of every speed, in (0, 1]."""
    watchdog_s: float | None = None
    """After so long without a sign of life the controller goes into a protective stop; None arms no watchdog."""
