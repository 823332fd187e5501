"""A dry run: the same moves, lifted so high that the brush meets neither paper nor ink; nothing is kept."""

from __future__ import annotations

from dataclasses import replace

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.rig.config import TRAVEL_CLEARANCE_MM, InkConfig, RigConfig

CLEAR_MM = 5.0
"""Least distance of the tip from the paper at the deepest point."""
BEGUN = "dry run: nothing is pressed, dipped or kept"
OVER = "dry run: every move was made"


class DryRunEngine(Engine):
    """Engine that makes each move of a run, lifted. Its log does not name the session folder, which will be deleted."""

    presses = False

    def snapshot(self) -> Snapshot:
        """The state of the run, without the folder's path in the log."""
        now = super().snapshot()
        return replace(now, messages=tuple(_without_path(line, now.folder) for line in now.messages))


def _without_path(line: str, folder: str) -> str:
    if line == f"session: {folder}":
        return BEGUN
    return OVER if line.startswith(f"closed: {folder}") else line


def lifted(rig: RigConfig, protocol: ProtocolConfig, by_mm: float) -> RigConfig:
    """The rig with paper and ink `by_mm` higher, and without touch, doses, self-check or judgement of captures.

    Raises `ConfigError`, with the allowed range, if the brush would still meet the paper or travel too low.
    """
    deepest_mm = max((stroke.condition.depth_mm for stroke in protocol.planned()), default=0.0)
    low_mm = deepest_mm + CLEAR_MM
    high_mm = rig.motion.safe_z_mm - rig.paper.touch_z_mm - TRAVEL_CLEARANCE_MM
    if not low_mm <= by_mm <= high_mm:
        raise ConfigError(
            "--dry-run",
            "",
            f"{by_mm:g} mm is outside [{low_mm:g}, {high_mm:g}] mm: above the deepest press, below travel",
        )
    return rig.checking_itself(False).model_copy(
        update={
            "paper": rig.paper.model_copy(update={"touch_z_mm": rig.paper.touch_z_mm + by_mm}),
            "ink": _lifted_ink(rig.ink, by_mm),
            "touch": rig.touch.model_copy(update={"method": "taught", "points_mm": []}),
            "quality": rig.quality.model_copy(update={"enabled": False}),
        }
    )


def _lifted_ink(ink: InkConfig, by_mm: float) -> InkConfig:
    wipe = None if ink.wipe is None else ink.wipe.model_copy(update={"z_mm": ink.wipe.z_mm + by_mm})
    wash = None if ink.wash is None else ink.wash.model_copy(update={"dip_z_mm": ink.wash.dip_z_mm + by_mm})
    return ink.model_copy(update={"dip_z_mm": ink.dip_z_mm + by_mm, "wipe": wipe, "wash": wash, "device": None})
