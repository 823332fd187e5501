"""What a protocol has planned: one entry a stroke, in the order in which they are made."""

from __future__ import annotations

from dataclasses import dataclass

from collect.protocols.config import Figure


@dataclass(frozen=True, slots=True)
class Planned:
    """One stroke, or one figure of several."""

    stroke_id: str
    height_mm: float
    """Depth; of a figure, its deepest."""
    tilt_deg: float
    """Of a figure, at its deepest point."""
    repeat: int
    """Round, from 1."""
    index: int = 0
    """Number in the plan before it was balanced over the sheet: what its steps' keys are made with, so that they do not
    depend on the sheet."""
    dwell_s: float = 0.0
    figure: Figure | None = None
    """What is drawn; None is a press."""
    cell_mm: tuple[float, float] | None = None
    """Paper cell that it needs; None is the rig's own, `paper.cell_mm`."""
    again_of: str | None = None
    """The stroke of another session that this one repeats."""
