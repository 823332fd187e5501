"""A dry run's engine: it writes a session as ever, into a folder that is thrown away, and its log names none of it."""

from __future__ import annotations

from dataclasses import replace

from collect.engine.engine import Engine
from collect.engine.snapshot import Snapshot

BEGUN = "rehearsal: nothing is pressed, dipped or kept"
OVER = "rehearsal: every move was made"


class DryRunEngine(Engine):
    """Makes every move, lifted; its recording is discarded."""

    presses = False

    def snapshot(self) -> Snapshot:
        """The engine now, its log without the paths that will be gone."""
        now = super().snapshot()
        return replace(now, messages=tuple(_without_path(line, now.folder) for line in now.messages))


def _without_path(line: str, folder: str) -> str:
    if line == f"session: {folder}":
        return BEGUN
    return OVER if line.startswith(f"closed: {folder}") else line
