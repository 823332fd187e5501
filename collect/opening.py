"""Which session a command works on: resume the open one that it was started with, or make a new one."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from collect.config import GridConfig, RigConfig
from collect.errors import ConfigError
from collect.rig import Rig
from drivers.clock import Clock
from sessions.schemas import Header, Source
from sessions.store import SessionStore, Snapshots, differences, next_session_id, open_sessions


@dataclass(frozen=True, slots=True)
class Opening:
    """What the command line said about the session."""

    root: Path
    rig_path: Path
    protocol_path: Path
    new: bool = False
    """Start a new session although another one is open."""
    fresh_sheet: bool = False
    """The operator has put a fresh sheet in."""
    armed: bool = False
    """The operator has looked at the cell: real hardware may move."""

    def snapshots(self) -> Snapshots:
        """The configuration as text, for the session's folder."""
        return {
            "rig.toml": self.rig_path.read_text(encoding="utf-8"),
            "protocol.toml": self.protocol_path.read_text(encoding="utf-8"),
        }


def find_resumable(opening: Opening) -> Path | None:
    """The open session to go on with, None for a new one. Raises `ConfigError` where the configuration changed."""
    if opening.new or not opening.root.is_dir():
        return None
    changed: list[tuple[Path, str]] = []
    for folder in reversed(open_sessions(opening.root)):
        difference = differences(folder, opening.snapshots())
        if not difference:
            return folder
        changed.append((folder, difference))
    if changed:
        folder, difference = changed[0]
        raise ConfigError(
            opening.protocol_path,
            "",
            f"session {folder.name} is open, but was started with another configuration:\n{difference}\n"
            "Go on with the old configuration, or start a new session with --new.",
        )
    return None


def open_store(
    opening: Opening, resume: Path | None, rig: Rig, config: RigConfig, protocol: GridConfig, clock: Clock
) -> SessionStore:
    """Make or resume the session. Raises `ConfigError` for unarmed hardware or another robot than before."""
    if not rig.robot_identity.simulated and not opening.armed:
        raise ConfigError(
            opening.rig_path,
            "robot",
            f"{rig.robot_identity.model} at {config.robot.host}:{config.robot.port} is real hardware: "
            "look at the cell, keep a hand at the emergency stop, then add --arm",
        )
    header = _header(opening, rig, config, protocol)
    if resume is None:
        session_id = next_session_id(opening.root, protocol.kind, dt.date.today())
        header = header.model_copy(update={"session_id": session_id})
        return SessionStore.create(opening.root / session_id, header, opening.snapshots(), clock.now_ns)
    store = SessionStore(resume, None, clock.now_ns)
    if (store.header.source, store.header.robot) != (header.source, header.robot):
        store.release()
        raise ConfigError(
            opening.rig_path,
            "robot",
            f"session {resume.name} was begun on {store.header.robot} ({store.header.source}), "
            f"but {header.robot} ({header.source}) answers",
        )
    if opening.fresh_sheet:
        store.fresh_sheet()
    return store


def _header(opening: Opening, rig: Rig, config: RigConfig, protocol: GridConfig) -> Header:
    return Header(
        session_id="",
        source=Source.LOOPBACK if rig.robot_identity.simulated else Source.REAL,
        software=f"brushloop {version('brushloop')}",
        robot=rig.robot_identity.model,
        robot_firmware=rig.robot_identity.firmware,
        camera=rig.camera_identity.model,
        lens=config.camera.lens,
        brush=config.brush.name,
        brush_radius_mm=config.brush.radius_mm,
        brush_length_mm=config.brush.length_mm,
        ink=config.ink.name,
        paper=config.paper.name,
        protocol=protocol.model_dump_json(),
        origin=f"{config.name}, {opening.rig_path.name}",
    )
