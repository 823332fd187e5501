"""The condition of a press: what the arm was told to do."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Condition:
    """Depth H below the paper, tilt alpha of the brush axis from the vertical, and heading of the mark."""

    depth_mm: float
    tilt_deg: float
    heading_deg: float = 0.0
