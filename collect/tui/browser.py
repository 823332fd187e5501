"""Data and actions of the start screen: recent sessions and their state, the rig's health, and engines.

Heavy imports wait until they are needed, so that the screen is up first.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from brushloop.collect.headless import RunnableEngine
    from brushloop.collect.rig.doctor import Finding
    from brushloop.sessions.show import Details, Summary

RECENT = 50
CHOSEN_FILES = ".files"
"""File in the folder of sessions that names the rig and the protocol chosen last."""
MAX_CHARS = 10_000


@dataclass(frozen=True, slots=True)
class Paths:
    """Paths of the rig, the protocol and the folder of sessions."""

    root: Path = Path("sessions")
    config: Path = Path("rig.toml")
    protocol: Path = Path("protocol.toml")


EngineFor = Callable[..., "RunnableEngine"]
"""Makes the engine of a run, not yet started; see `collect.start.engine_for`."""


class SessionBrowser:
    """Reads sessions and makes engines; connects to devices only in `health`."""

    def __init__(self, paths: Paths, engine_for: EngineFor) -> None:
        self._kept = paths.root / CHOSEN_FILES
        self._engine_for = engine_for
        with contextlib.suppress(OSError, ValueError), self._kept.open(encoding="utf-8") as stream:
            config, protocol = stream.read(MAX_CHARS).splitlines()
            paths = replace(paths, config=Path(config), protocol=Path(protocol))
        self.paths = paths

    def choose(self, config: str, protocol: str) -> None:
        """Use another rig and another protocol, here and at the next start; an empty name keeps the file as it is."""
        before, names = self.paths, [config.strip(), protocol.strip()]
        self.paths = replace(before, config=Path(names[0] or before.config), protocol=Path(names[1] or before.protocol))
        if self.paths != before:
            with contextlib.suppress(OSError):  # then the choice holds until the program ends
                self._kept.parent.mkdir(parents=True, exist_ok=True)
                self._kept.write_text(f"{self.paths.config}\n{self.paths.protocol}\n", encoding="utf-8")

    def recent(self) -> list[Summary]:
        """The newest sessions first; empty if there is no folder yet."""
        from brushloop.sessions.show import summaries

        if not self.paths.root.is_dir():
            return []
        return sorted(summaries(self.paths.root), key=lambda row: row.session_id, reverse=True)[:RECENT]

    def standing(self, session_id: str) -> Details:
        """What of a session is finished, what is void and what comes next. Raises `SessionError`."""
        from brushloop.sessions.show import details

        return details(self.paths.root / session_id)

    def health(self) -> list[Finding]:
        """What every device answers; takes seconds, powers nothing. Raises `ConfigError`."""
        import asyncio

        from brushloop.collect.rig.config import load_rig
        from brushloop.collect.rig.doctor import examine
        from brushloop.drivers.host import HostClock

        return asyncio.run(examine(load_rig(self.paths.config), HostClock()))

    def planned(self) -> str:
        """What the protocol would do, in one line. Raises `ConfigError`."""
        from brushloop.collect.planning.summary import make_plan
        from brushloop.collect.protocols.config import load_protocol
        from brushloop.collect.rig.config import load_rig

        plan = make_plan(load_rig(self.paths.config).settled(armed=False), load_protocol(self.paths.protocol))
        sheets = "1 sheet" if plan.sheets == 1 else f"{plan.sheets} sheets"
        return f"{len(plan.placed)} strokes on {sheets}, about {plan.seconds / 60:.0f} min"

    def engine(self, session_id: str | None, *, preview: bool) -> RunnableEngine:
        """An engine that resumes that open session, with the set-up wizard; with None, one for a new session.

        A session goes on with its own protocol. Connects nothing yet. Raises `ConfigError`.
        """
        from brushloop.collect.engine.open_or_resume import PROTOCOL_EFFECTIVE, Opening

        root, config, protocol = self.paths.root, self.paths.config, self.paths.protocol
        if session_id is None:
            opening = Opening.load(root, config, protocol, new=True, sheet=1)
        else:
            opening = Opening.load(root, config, root / session_id / PROTOCOL_EFFECTIVE)
            opening = replace(opening, resume=session_id)
        return self._engine_for(opening, watched=True, guided=True, preview=preview)
