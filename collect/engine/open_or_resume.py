"""Decides which session a command works on: an open one that was begun with the same files, or a new one.

The finished steps of a resumed session are read from its journal (`sessions/journal/`); `collect/engine/run.py` carries
out only the others.
"""

from __future__ import annotations

import datetime as dt
import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from brushloop.collect.engine import CollectRequest
from brushloop.collect.engine.live import LiveView
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import ProtocolConfig, load_protocol
from brushloop.collect.rig.config import TRAVEL_CLEARANCE_MM, RigConfig, load_rig, overrides
from brushloop.collect.rig.devices import Rig
from brushloop.drivers.devices import Identity
from brushloop.drivers.host import Clock
from brushloop.sessions.disk import MAX_SNAPSHOT_BYTES, check_folder, read_bounded
from brushloop.sessions.errors import InputError, SessionError
from brushloop.sessions.events import CaptureResult, PressResult
from brushloop.sessions.journal import JOURNAL_NAME, PROTOCOL_EFFECTIVE, RIG_EFFECTIVE, replay
from brushloop.sessions.records import Header, Source
from brushloop.sessions.store import SessionStore

COMPARED = {RIG_EFFECTIVE: "rig.toml", PROTOCOL_EFFECTIVE: "protocol.toml"}
"""Files whose values are compared, environment and side files included, and the names by which users know them."""
MACHINE_NAMES = {
    "robot": {"host", "port", "rtde_port"},
    "camera": {"source"},
    "force": {"interface", "channel", "host", "port"},
    "ink": {"device": {"port"}},
}
"""Fields that may differ between two runs of one session: where the devices are, not what they do."""
CLEAR_MM = 5.0
"""Least distance of the tip from the paper at the deepest point of a dry run."""


@dataclass(frozen=True, slots=True)
class Opening:
    """A request with its configuration, which is read only once."""

    request: CollectRequest
    rig: RigConfig
    protocol: ProtocolConfig
    snapshots: dict[str, str]
    """Texts of the files that a new session keeps, by name."""
    live: LiveView | None = None
    """Shows the run to viewers."""

    @classmethod
    def load(cls, request: CollectRequest) -> Opening:
        """Read both files. Raises `ConfigError`."""
        rig, protocol = load_rig(request.config), load_protocol(request.protocol)
        snapshots = {
            "rig.toml": request.config.read_text(encoding="utf-8"),
            "protocol.toml": request.protocol.read_text(encoding="utf-8"),
            # The effective values: a touch height from the environment is part of the record.
            RIG_EFFECTIVE: rig.model_dump_json(indent=2, exclude=MACHINE_NAMES) + "\n",
            # Includes the rows of the tables that the protocol names.
            PROTOCOL_EFFECTIVE: protocol.model_dump_json(indent=2) + "\n",
        }
        rig = rig.settled(request.armed)
        if request.dry_run_mm is not None:
            rig = _lifted(rig, protocol, request.dry_run_mm)
        return cls(request, rig, protocol, snapshots)


def _lifted(rig: RigConfig, protocol: ProtocolConfig, by_mm: float) -> RigConfig:
    """The rig with paper and ink `by_mm` higher, and without touch, doses, self-check or judgement of captures.

    Raises `ConfigError`, with the allowed range, if the brush would still meet the paper or travel too low.
    """
    deepest_mm = max(stroke.condition.depth_mm for stroke in protocol.planned())
    low_mm = deepest_mm + CLEAR_MM
    high_mm = rig.motion.safe_z_mm - rig.paper.touch_z_mm - TRAVEL_CLEARANCE_MM
    if not low_mm <= by_mm <= high_mm:
        raise ConfigError(
            "--dry-run",
            "",
            f"{by_mm:g} mm must lie in [{low_mm:g}, {high_mm:g}] mm: above the deepest press, below travel height",
        )
    ink, dip_z_mm = rig.ink, rig.ink.dip_z_mm + by_mm
    wipe = None if ink.wipe is None else ink.wipe.model_copy(update={"z_mm": ink.wipe.z_mm + by_mm})
    wash = None if ink.wash is None else ink.wash.model_copy(update={"dip_z_mm": ink.wash.dip_z_mm + by_mm})
    return rig.model_copy(
        update={
            "self_check": rig.self_check.model_copy(update={"enabled": False}),
            "paper": rig.paper.model_copy(update={"touch_z_mm": rig.paper.touch_z_mm + by_mm}),
            "ink": ink.model_copy(update={"dip_z_mm": dip_z_mm, "wipe": wipe, "wash": wash, "device": None}),
            "touch": rig.touch.model_copy(update={"method": "taught", "points_mm": []}),
            "quality": rig.quality.model_copy(update={"enabled": False}),
        }
    )


def find_resumable(opening: Opening) -> Path | None:
    """Return the open session to resume, or None to start a new one.

    Raises `ConfigError` if the configuration changed, or if a new session might press on a used sheet.
    """
    request = opening.request
    if not request.out.is_dir():
        return None
    if request.resume is not None:
        folders = [request.out / request.resume]
    else:
        folders = [] if request.new else open_sessions(request.out)
    for folder in reversed(folders):
        if not differences(folder, opening.snapshots):
            return folder
    if folders:
        newest = folders[-1]
        way_out = (
            f"Resume it with --config {newest / 'rig.toml'} --protocol {newest / 'protocol.toml'}. Each must be beside "
            "the files that it names, and the environment variables the same. Or start a new session with --new."
        )
        what = ["was begun with another configuration:", *differences(newest, opening.snapshots), way_out]
        raise ConfigError(newest, "", "\n".join(what))
    check_fresh_sheet(request.out, request.sheet)
    return None


def check_fresh_sheet(root: Path, sheet: int | None) -> None:
    """Raise `ConfigError` if a new session under `root` might press on a used sheet; `sheet` is what was confirmed.

    A session that cannot be read may have pressed; it is named, because the user may have meant to resume it.
    """
    pressed, unreadable = False, ""
    for journal in sorted(root.glob(f"*/{JOURNAL_NAME}")) if sheet is None else ():
        try:
            pressed = pressed or bool(replay(journal).used_patches)
        except SessionError as error:
            unreadable = f" One of them cannot be resumed: {error}; see `brushloop sessions verify {journal.parent}`."
    if pressed or unreadable:
        raise ConfigError(
            root,
            "",
            f"holds earlier sessions, and a new one would press on the sheet that is in place.{unreadable} "
            "Put a fresh sheet in, then confirm it with --sheet 1",
        )
    if sheet not in (None, 1):
        raise ConfigError("--sheet", "", f"{sheet}: a new session begins with sheet 1")


def differences(folder: Path, snapshots: Mapping[str, str]) -> list[str]:
    """What differs between the session's configuration and `snapshots` (file name -> text), a line for each value.

    A line is such as `rig.toml: paper.cell_mm: [80.0, 80.0] -> [40.0, 24.0]`; items of a list are numbered from 0, and
    a value from the environment has the name of its variable behind it.
    """
    lines: list[str] = []
    for file, name in COMPARED.items():
        try:
            old = dict(_values(json.loads(read_bounded(folder / file, MAX_SNAPSHOT_BYTES))))
        except (InputError, ValueError, RecursionError):
            lines.append(f"{name}: its earlier content is missing or damaged")
            continue
        new = dict(_values(json.loads(snapshots[file])))
        variables = overrides() if file == RIG_EFFECTIVE else {}
        for field in {**new, **old}:
            before, after = old.get(field, "left out"), new.get(field, "left out")
            if before != after:
                by = f" (by {variables[field]})" if field in variables else ""
                lines.append(f"{name}: {'.'.join(field)}: {before:.40} -> {after:.40}{by}")
    return lines


def _values(value: Any, at: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], str]]:
    """(path of a field, its value as JSON) for everything in tables and lists of tables that is not left out."""
    if isinstance(value, list) and any(isinstance(item, dict) for item in cast("list[Any]", value)):
        value = {str(number): item for number, item in enumerate(cast("list[Any]", value))}
    if isinstance(value, dict):
        for name, item in cast("dict[str, Any]", value).items():
            yield from _values(item, (*at, name))
    elif value is not None:
        yield at, json.dumps(value, ensure_ascii=False)


def put_in_sheet(store: SessionStore, sheet: int | None) -> None:
    """Record which sheet the operator says is in; the same number again changes nothing.

    Raises `ConfigError` for an impossible number, or while a stroke still has to be photographed.
    """
    now = store.state.sheet + 1
    if sheet is None or sheet == now:
        return
    if sheet != now + 1:
        raise ConfigError("--sheet", "", f"{sheet}: sheet {now} is in use, so only {now} or {now + 1} can be in place")
    pressed, captured = (
        {(result.press.stroke_id, result.press.take) for result in store.state.results(kind)}
        for kind in (PressResult, CaptureResult)
    )
    if waiting := pressed - captured:
        names = ", ".join(sorted(stroke_id for stroke_id, _take in waiting))
        raise ConfigError(
            "--sheet",
            "",
            f"{sheet}: {names} is pressed on sheet {now} but not photographed. "
            f"Put sheet {now} back and run the same command without --sheet",
        )
    store.fresh_sheet()


def open_sessions(root: Path) -> list[Path]:
    """Folders under `root` whose journal was opened and has no `closed` event, oldest first.

    A session that is damaged or holds links is left out, so that it stands in no other's way.
    """
    folders: list[Path] = []
    for journal in sorted(root.glob(f"*/{JOURNAL_NAME}")):
        try:
            check_folder(journal.parent)
            if replay(journal).is_open:
                folders.append(journal.parent)
        except SessionError:
            continue
    return folders


def open_store(opening: Opening, resume: Path | None, rig: Rig, clock: Clock) -> SessionStore:
    """Make or resume the session. Raises `ConfigError` if it was begun on another robot."""
    if resume is None:
        # `2026-11-21-grid-01`, with the first number that is free.
        name = f"{dt.date.today().isoformat()}-{opening.protocol.kind}"
        folders = (opening.request.out / f"{name}-{number:02d}" for number in itertools.count(1))
        folder = next(folder for folder in folders if not folder.exists())
        return SessionStore.create(folder, _header(opening, rig, folder.name), opening.snapshots, clock.now_ns)
    header, store = _header(opening, rig, resume.name), SessionStore(resume, clock.now_ns)
    try:
        # Before anything moves: damage to a step would otherwise show only when everything is collected.
        store.verify()
        if (store.header.source, store.header.robot) != (header.source, header.robot):
            raise ConfigError(
                opening.request.config,
                "robot",
                f"session {resume.name} was begun on {store.header.robot} ({store.header.source}), "
                f"but {header.robot} ({header.source}) answers",
            )
        put_in_sheet(store, opening.request.sheet)
    except BaseException:
        store.release()
        raise
    return store


def _header(opening: Opening, rig: Rig, session_id: str) -> Header:
    config = opening.rig
    return Header(
        session_id=session_id,
        source=Source.LOOPBACK if rig.simulated else Source.REAL,
        software=f"brushloop {version('brushloop')}",
        robot=rig.identities["robot"].model,
        robot_firmware=rig.identities["robot"].firmware,
        camera=rig.identities["camera"].model,
        lens=config.camera.lens,
        brush=config.brush.name,
        brush_radius_mm=config.brush.radius_mm,
        brush_length_mm=config.brush.length_mm,
        ink=config.ink.name,
        ink_device=_who(rig.identities.get("ink")),
        force_sensor=_who(rig.identities.get("force")),
        paper=config.paper.name,
        protocol=opening.protocol.model_dump_json(),
        origin=f"{config.name}, {opening.request.config.name}",
    )


def _who(identity: Identity | None) -> str:
    return "" if identity is None else " ".join(part for part in (identity.model, identity.firmware) if part)
