"""The engine: runs a protocol on a rig, step by step, and makes each stroke exactly once; and what is asked of it.

Used by the commands, the screens and the first day's proof; the only part of collect that writes a session. The
options of `brushloop collect` are the annotated fields of its request, as `calibrate.commands` says. Nothing heavy is
imported here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Option

RIG_FILE, PROTOCOL_FILE = Path("rig.toml"), Path("protocol.toml")
Rig = Annotated[Path, Option(help="The rig.toml: addresses, frames and limits of the rig.")]
Arm = Annotated[bool, Option("--arm", help="Let real hardware move.")]
Tui = Annotated[bool | None, Option("--tui/--no-tui", help="Show the screen, by default in any terminal.")]
NewSheet = Annotated[int | None, Option(min=1, help="Confirm that sheet N is in place; the option may be repeated.")]


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """Collect strokes. Ctrl-C stops the arm; run the same command again to resume."""

    config: Rig = RIG_FILE
    protocol: Annotated[Path, Option(help="The protocol to carry out.")] = PROTOCOL_FILE
    out: Annotated[Path, Option(help="Folder that holds sessions.")] = Path("sessions")
    new: Annotated[bool, Option("--new", help="Start a new session although one is open.")] = False
    sheet: NewSheet = None
    armed: Arm = False
    """The operator has looked at the robot cell."""
    dry_run_mm: Annotated[
        float | None,
        Option("--dry-run", help="Make every move this many mm higher; nothing is pressed, dipped or kept."),
    ] = None
    on_screen: Tui = None
    """A screen shows run and camera, and can answer questions."""
    guided: Annotated[bool, Option("--set-up", help="Ask on the screen if each set-up step is good enough.")] = False
    live: Annotated[bool, Option("--live", help="Let a Foxglove viewer on this machine watch the run.")] = False
    live_port: Annotated[int, Option(min=0, max=65535, help="Port of --live; 0 takes any free one.")] = 8765
    resume: str | None = None
    """Id of the session to resume, and no other."""
