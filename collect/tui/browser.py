"""What the start screen works with: the sessions that there are, how each stands, the rig's health, and engines.

Imports wait for what is asked: the screen is up first.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collect.engine.engine import Engine
    from collect.rig.doctor import Finding
    from sessions.repair.verify import Verdict
    from sessions.show import Details, Summary

RECENT = 50
COLUMNS = 68
"""Of what commands say: as wide as the finish page is on a terminal of 80."""


@dataclass(frozen=True, slots=True)
class Paths:
    """Which rig and protocol, and where sessions lie."""

    root: Path = Path("sessions")
    config: Path = Path("rig.toml")
    protocol: Path = Path("protocol.toml")


class Desk:
    """Reads, and makes engines; connects to nothing by itself but in `health`."""

    def __init__(self, paths: Paths) -> None:
        self.paths = paths

    def choose(self, config: str, protocol: str) -> None:
        """Another rig, another protocol."""
        self.paths = replace(self.paths, config=Path(config), protocol=Path(protocol))

    def recent(self) -> list[Summary]:
        """The newest sessions first; none where there is no folder yet."""
        from sessions.show import summaries

        if not self.paths.root.is_dir():
            return []
        return sorted(summaries(self.paths.root), key=lambda row: row.session_id, reverse=True)[:RECENT]

    def standing(self, session_id: str) -> Details:
        """What of a session is finished, void, and next. Raises `SessionError`."""
        from sessions.show import details

        return details(self.paths.root / session_id)

    def health(self) -> list[Finding]:
        """What every device answers; takes seconds, powers nothing. Raises `ConfigError`."""
        import asyncio

        from collect.rig.config import load_rig
        from collect.rig.doctor import examine
        from drivers.clock import HostClock

        return asyncio.run(examine(load_rig(self.paths.config), HostClock()))

    def planned(self) -> str:
        """What the protocol would do, in one line. Raises `ConfigError`."""
        from collect.planning.summary import make_plan
        from collect.protocols.files import load_protocol
        from collect.rig.config import load_rig

        made = make_plan(load_rig(self.paths.config).settled(armed=False), load_protocol(self.paths.protocol))
        sheets = "1 sheet" if made.sheets == 1 else f"{made.sheets} sheets"
        return f"{len(made.placed)} strokes on {sheets}, about {made.seconds / 60:.0f} min"

    def engine(self, session_id: str | None, *, guided: bool, preview: bool) -> Engine:
        """An engine to go on with that open session; with None, for a new one on a fresh sheet.

        Connects nothing yet. Raises `ConfigError`, also where another session goes on with these files.
        """
        from collect.engine.opening import Opening, find_resumable
        from collect.errors import ConfigError
        from collect.start import engine_for

        paths, new = self.paths, session_id is None
        opening = Opening.load(paths.root, paths.config, paths.protocol, new=new, sheet=1 if new else None)
        found = None if new else find_resumable(opening)
        if found is not None and found.name != session_id:
            raise ConfigError(paths.config, "", f"goes on with session {found.name}, which is open as well")
        return engine_for(opening, watched=True, guided=guided, preview=preview)


def verified(folder: Path) -> Verdict:
    """Every file read again. Raises `InputError`."""
    from sessions.repair.verify import verify_session

    return verify_session(folder)


def run_command(name: str, folder: Path) -> tuple[int, str]:
    """`brushloop NAME FOLDER` in a process of its own: (exit code, what it said; how far it got only where it failed).
    May take minutes."""
    command = [sys.executable, "-m", "brushloop", name, str(folder)]
    fits = os.environ | {"COLUMNS": str(COLUMNS)}
    ran = subprocess.run(command, capture_output=True, text=True, check=False, env=fits)
    return ran.returncode, (ran.stdout if ran.returncode == 0 else ran.stdout + ran.stderr).strip()
