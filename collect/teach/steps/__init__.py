"""The steps of the first day, one file each."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brushloop.collect.teach.day import Step


def all_steps() -> tuple[Step, ...]:
    """Every step, in order. Imported when they are needed: some bring a camera's libraries."""
    from brushloop.collect.teach.steps.arm import ArmStep
    from brushloop.collect.teach.steps.brush import BrushStep
    from brushloop.collect.teach.steps.camera import CameraStep
    from brushloop.collect.teach.steps.force import ForceStep
    from brushloop.collect.teach.steps.limits import LimitsStep
    from brushloop.collect.teach.steps.places import PlacesStep
    from brushloop.collect.teach.steps.proof import ProofStep
    from brushloop.collect.teach.steps.sheet import SheetStep
    from brushloop.collect.teach.steps.tip import TipStep

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
