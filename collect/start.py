"""One run of `brushloop collect`: read, check and open the session, then hand over to a screen or a progress bar."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from brushloop.collect.chains.commands import ending
from brushloop.collect.engine.dry_run import DryRunEngine
from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.live import LiveView
from brushloop.collect.engine.open_or_resume import Opening, check_writable, find_resumable, open_store
from brushloop.collect.headless import RunnableEngine, run_headless
from brushloop.collect.planning.limit_check import check_protocol
from brushloop.drivers.clock import HostClock
from brushloop.sessions.terminal import plain

if TYPE_CHECKING:
    from brushloop.collect.tui.pictures import Preview


class Settings(TypedDict):
    """Options of an engine that stay the same when the session is resumed on the screen."""

    live: LiveView | None
    guided: bool
    preview: bool


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


def start(
    opening: Opening, *, on_screen: bool, live: LiveView | None = None, guided: bool = False, preview: Preview = "auto"
) -> int:
    """Run to the end and print where the recording lies and what comes next; return how many strokes were left out.

    Raises the error that ended the run.
    """
    settings: Settings = {"live": live, "guided": guided, "preview": on_screen and preview != "off"}
    engine = engine_for(opening, watched=on_screen, **settings)

    def again(session_id: str) -> Engine:
        return engine_for(replace(opening, new=False, resume=session_id), watched=True, **settings)

    with contextlib.ExitStack() as stack:
        if live is not None:
            live.start()
            stack.callback(live.close)
        now = _run(engine, preview, again, on_screen=on_screen).snapshot()
    _say(ending(Path(now.folder), opening.protocol.kind))
    return now.given_up


def collect_session(
    config: Path, protocol: Path, out: Path = Path("sessions"), *, sheet: int | None = None, armed: bool = False
) -> Path:
    """Carry out a protocol without a screen, as `brushloop collect --no-tui` does; return the session's folder.

    `sheet` confirms that this sheet is in, `armed` lets real hardware move. An open session of the same files is
    resumed. Raises `ConfigError`, `CollectAborted`, `SessionError` and what the devices raise.
    """
    opening = Opening.load(Path(out), Path(config), Path(protocol), sheet=sheet, armed=armed)
    engine = engine_for(opening, watched=False)
    run_headless(engine)
    return Path(engine.snapshot().folder)


def dry_run(config: Path, protocol: Path, depth_mm: float, *, armed: bool, on_screen: bool) -> None:
    """Move through the protocol in the air; the recording is thrown away, so that no cell counts as used."""
    with tempfile.TemporaryDirectory(prefix="brushloop-dry-") as folder:
        opening = Opening.load(Path(folder), config, protocol, armed=armed, dry_run_mm=depth_mm)
        _run(
            engine_for(opening, watched=on_screen, preview=on_screen, make=DryRunEngine),
            "auto",
            None,
            on_screen=on_screen,
        )
    _say("dry run done; nothing was kept\n")


def _run(
    engine: RunnableEngine, preview: Preview, again: Callable[[str], Engine] | None, *, on_screen: bool
) -> RunnableEngine:
    """Run to the end; return the engine that ran last, as the operator may resume after a stop."""
    if on_screen:
        from brushloop.collect.tui.runner import run_screen

        return run_screen(engine, preview, again)
    run_headless(engine)
    return engine


def _say(text: str) -> None:
    try:
        sys.stdout.write(plain(text, keep="\n"))
        sys.stdout.flush()
    except OSError:
        sys.stdout = None  # the reader is gone; Python would write again at exit and change the exit code
