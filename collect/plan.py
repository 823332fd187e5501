"""What a protocol asks for, against the limits, before anything is connected."""

from __future__ import annotations

from pathlib import Path

from collect.config import RigConfig
from collect.planning.limits import check_protocol
from collect.protocols.config import ProtocolConfig


def check_plan(rig_path: Path, protocol_path: Path, rig: RigConfig, protocol: ProtocolConfig) -> None:
    """Raise `ConfigError` naming file, field and range for the first thing that cannot be done."""
    check_protocol(rig_path, protocol_path, rig, protocol)
