"""One run of `brushloop collect`: read, check and open the session, then hand over to a screen or a progress bar."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from brushloop.collect.engine.engine import DryRunEngine, Engine
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.open_or_resume import Opening, find_resumable, open_store
from brushloop.collect.headless import run_headless
from brushloop.collect.planning.limit_check import check_protocol
from brushloop.drivers.host import HostClock
from brushloop.sessions.disk import check_writable
from brushloop.sessions.terminal import say

PRESSES = frozenset({"grid", "few-strokes", "list"})
"""Protocols whose recording can be calibrated and validated by itself; after others, no single next command exists."""


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """What is collected, and how."""

    config: Path
    protocol: Path
    out: Path = Path("sessions")
    """Folder that holds sessions."""
    new: bool = False
    """Start a new session although one is open."""
    sheet: int | None = None
    """Number of the sheet that the operator has put in."""
    armed: bool = False
    """Whether real hardware may move."""
    on_screen: bool = False
    guided: bool = False
    """Whether the operator accepts on the screen what each set-up step measured."""
    live: LiveView | None = None


class Collected(NamedTuple):
    """A finished session, and how many strokes it left out."""

    folder: Path
    left_out: int


def engine_for(
    opening: Opening,
    *,
    watched: bool,
    live: LiveView | None = None,
    guided: bool = False,
    preview: bool = False,
    make: type[Engine] = Engine,
) -> Engine:
    """Make an engine that resumes the open session or begins a new one; connects nothing yet. Raises `ConfigError`."""
    resume = find_resumable(opening)
    if resume is not None:
        opening = opening.as_begun(resume)
    check_protocol(opening.rig_path, opening.protocol_path, opening.rig, opening.protocol)
    check_writable(resume or opening.root)
    clock = HostClock()
    return make(
        opening.rig,
        opening.protocol,
        lambda rig: open_store(opening, resume, rig, clock),
        clock,
        resumes=resume,
        watched=watched,
        armed=opening.armed,
        live=live,
        guided=guided,
        preview=preview,
    )


def collect(request: CollectRequest) -> Collected:
    """Run to the end and print where the recording lies and what comes next. Raises the error that ended the run."""
    opening = Opening.load(
        request.out, request.config, request.protocol, new=request.new, sheet=request.sheet, armed=request.armed
    )

    def make(resume: str | None = None) -> Engine:
        return engine_for(
            opening if resume is None else replace(opening, new=False, resume=resume),
            watched=request.on_screen,
            live=request.live,
            guided=request.guided,
            preview=request.on_screen,
        )

    engine = make()
    with nullcontext() if request.live is None else closing(request.live):
        if request.live is not None:
            request.live.start()
        now = _run(engine, make, on_screen=request.on_screen).snapshot()
    folder = Path(now.folder)
    say(*ending(folder, opening.protocol.kind))
    return Collected(folder, now.given_up)


def collect_session(
    config: Path, protocol: Path, out: Path = Path("sessions"), *, sheet: int | None = None, armed: bool = False
) -> Path:
    """Carry out a protocol without a screen, as `brushloop collect --no-tui` does; return the session's folder.

    `sheet` confirms that this sheet is in, `armed` lets real hardware move. An open session of the same files is
    resumed. Raises `ConfigError`, `CollectAborted`, `SessionError` and what the devices raise.
    """
    return collect(CollectRequest(Path(config), Path(protocol), Path(out), sheet=sheet, armed=armed)).folder


def dry_run(config: Path, protocol: Path, depth_mm: float, *, armed: bool, on_screen: bool) -> None:
    """Move through the protocol in the air; the recording is thrown away, so that no cell counts as used."""
    with tempfile.TemporaryDirectory(prefix="brushloop-dry-") as folder:
        opening = Opening.load(Path(folder), config, protocol, armed=armed, dry_run_mm=depth_mm)
        engine = engine_for(opening, watched=on_screen, preview=on_screen, make=DryRunEngine)
        _run(engine, None, on_screen=on_screen)
    say("dry run done; nothing was kept")


def ending(folder: Path, kind: str) -> list[str]:
    """Lines that name the recording of a finished session and the next command; `kind` is its protocol's kind."""
    lines = [f"recorded: {folder / folder.name}.mcap"]
    if kind in PRESSES:
        # It may have been calibrated on the screen already.
        command = "validate" if (folder / "calibration").is_dir() else "calibrate"
        lines.append(f"next:     brushloop {command} {folder}")
    return lines


def _run(engine: Engine, again: Callable[[str], Engine] | None, *, on_screen: bool) -> Engine:
    """Run to the end; return the engine that ran last, as the operator may resume after a stop."""
    if not on_screen:
        run_headless(engine)
        return engine
    from brushloop.collect.tui.app import OperatorApp, run_app
    from brushloop.collect.tui.pictures import Pictures

    app = OperatorApp(engine, again=again, pictures=Pictures(pixels=True))
    run_app(app)
    return app.engine or engine
