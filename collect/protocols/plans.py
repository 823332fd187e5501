"""Any protocol: what it has planned, and its steps."""

from __future__ import annotations

from collect.protocols import adaptive, calibration, grid, listed, replay, write
from collect.protocols.config import (
    AdaptiveConfig,
    CalibrationConfig,
    GridConfig,
    ListConfig,
    ProtocolConfig,
    ReplayConfig,
    WriteConfig,
)
from collect.protocols.steps import Protocol
from collect.protocols.strokes import Planned
from collect.rig.paper import Layout


def planned(config: ProtocolConfig, layout: Layout | None = None) -> list[Planned]:
    """Every stroke exactly once, in order; of `adaptive` the worst case. Empty for `calibration`."""
    match config:
        case GridConfig():
            return grid.planned(config, layout)
        case AdaptiveConfig():
            return adaptive.planned(config)
        case ListConfig():
            return listed.planned(config, layout)
        case ReplayConfig():
            return replay.planned(config, layout)
        case WriteConfig():
            return write.planned(config, layout)
        case CalibrationConfig():
            return []


def steps(config: ProtocolConfig, layout: Layout | None = None) -> Protocol:
    """The generator to run. Which keys its steps have does not depend on the layout, only in what order they come."""
    match config:
        case GridConfig():
            return grid.steps(config, layout)
        case AdaptiveConfig():
            return adaptive.steps(config)
        case ListConfig():
            return listed.steps(config, layout)
        case ReplayConfig():
            return replay.steps(config, layout)
        case WriteConfig():
            return write.steps(config, layout)
        case CalibrationConfig():
            return calibration.steps(config)


def cell_mm(config: ProtocolConfig) -> tuple[float, float] | None:
    """The paper cell that it needs; None is the rig's own."""
    return config.cell_mm if isinstance(config, WriteConfig) else None
