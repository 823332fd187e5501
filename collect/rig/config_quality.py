"""Thresholds of the quality checks. `docs/quality.md` says what each measures and why its limit is where it is."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

Level = Annotated[float, Field(ge=0.0, le=255.0)]
Share = Annotated[float, Field(gt=0.0, lt=1.0)]
Length = Annotated[float, Field(gt=0.0, le=100.0)]
Area = Annotated[float, Field(gt=0.0, le=1e6)]


class QualityConfig(BaseModel):
    """Limits beyond which a capture is not sound."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    enabled: bool = True
    """False records captures without judging them."""
    retakes: Annotated[int, Field(ge=0, le=10)] = 2
    """How often a stroke that failed is pressed again on a new patch before a person is asked."""
    dark_level: Level = 80.0
    """Gray level of the paper below which the picture is underexposed."""
    bright_level: Annotated[float, Field(ge=0.0, le=256.0)] = 250.0
    """Gray level of the paper from which the picture is overexposed, its pixels saturated. 256 = never."""
    blur_mm: Length = 0.25
    """Standard deviation of the blur on the paper, measured at the picture's steepest edges."""
    edge_mm: Length = 1.0
    """Least distance of ink from the edge of the frame: nearer ink may go on beyond it."""
    glare_share: Share = 0.1
    """How much brighter than the paper around it a spot must be to count as glare."""
    glare_mm2: Area = 6.0
    """Area of glare in the patch."""
    ink_gate: Share = 0.1
    """How far below the paper a spot must lie to count as ink, as a share of the paper's brightness."""
    foreign_mm2: Area = 1.5
    """Ink in the patch that is not the stroke's own; a patch that holds this much before a press is not blank."""
    blank_mm2_per_mm: Area = 0.1
    """A press that leaves less ink for each mm of its depth is blank."""
    uneven: Share = 0.125
    """Standard deviation of the darkness within a stroke, as a share of its mean, from which it counts as dry."""
    head_mm: Annotated[float, Field(ge=-20.0, le=20.0)] = 0.7
    """How far a sound mark begins behind the zero-touch point, on the side away from its tip."""
    misplaced_mm: Length = 1.6
    """Distance of the mark's head from where it should begin."""
    smeared_mm: Length = 4.0
    """How much longer than 1.6 times its depth, or wider than 0.65 times, a mark may be."""
    faint_tone: Share = 0.77
    """Darkness of the ink, 1 = reflects nothing, below which it is faint."""
    split_mm: Length = 0.3
    """Gap between two groups of hairs, averaged over 2 mm of its length."""
    bent_deg: Annotated[float, Field(gt=0.0, lt=90.0)] = 5.5
    """Angle between the heading and the direction of the mark from its head to its tip."""

    @model_validator(mode="after")
    def _ordered(self) -> QualityConfig:
        if self.dark_level >= self.bright_level:
            raise ValueError(f"dark_level = {self.dark_level:g} must be less than bright_level = {self.bright_level:g}")
        return self
