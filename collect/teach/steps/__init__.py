"""The steps of the first day, one file each."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collect.teach.day import Step


def all_steps() -> tuple[Step, ...]:
    """Every step, in order. Imported when they are needed: some bring a camera's libraries."""
    from collect.teach.steps.arm import ArmStep
    from collect.teach.steps.brush import BrushStep
    from collect.teach.steps.camera import CameraStep
    from collect.teach.steps.force import ForceStep
    from collect.teach.steps.limits import LimitsStep
    from collect.teach.steps.places import PlacesStep
    from collect.teach.steps.proof import ProofStep
    from collect.teach.steps.sheet import SheetStep
    from collect.teach.steps.tip import TipStep

    return (
        ArmStep(),
        CameraStep(),
        TipStep(),
        SheetStep(),
        PlacesStep(),
        BrushStep(),
        ForceStep(),
        LimitsStep(),
        ProofStep(),
    )
