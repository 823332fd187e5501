"""Commands that run other commands: the loop, writing, and the demo; and what is asked of each.

The options of a command are the annotated fields of its request, as `calibrate.commands` says. Nothing heavy is
imported here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from brushloop.calibrate.commands import CharacterData
from brushloop.collect.engine import RIG_FILE, Arm, NewSheet, Rig, Tui


@dataclass(frozen=True, slots=True)
class LoopRequest:
    """Recover every press from its image, press it again and compare both. Run the same command again to resume."""

    session: Annotated[Path, Argument(help="The session whose presses are recovered from their images and made again.")]
    config: Rig = RIG_FILE
    out: Annotated[Path | None, Option(help="Folder for the results; <session>/loop by default.")] = None
    presses: Annotated[int | None, Option(min=1, help="Use this many presses, spread evenly over the session.")] = None
    seed: Annotated[int, Option(min=0, help="Seed of the random order of the presses.")] = 1
    sheet: NewSheet = None
    armed: Arm = False
    tui: Tui = None


@dataclass(frozen=True, slots=True)
class WritingRequest:
    """Plan characters, write them on the rig, compare with simulation and reference. Run it again to resume."""

    what: Annotated[str, Argument(help="Characters to write; brushloop ships 字 子 永.")]
    config: Rig = RIG_FILE
    out: Annotated[Path, Option(help="Folder for the plan and the report.")] = Path("written")
    sessions: Annotated[Path, Option(help="Folder that holds sessions.")] = Path("sessions")
    repeats: Annotated[int, Option(min=1, max=1000, help="How often each character is written.")] = 1
    learn: Annotated[int, Option(min=0, max=20, help="First learn better plans, in at most this many rounds.")] = 0
    learn_repeats: Annotated[int, Option(min=1, max=100, help="How often a round of learning writes a character.")] = 2
    practice: Annotated[bool, Option(help="First write a practice sheet, and fit the brush model to its ink.")] = False
    data: CharacterData = None
    cell_mm: Annotated[float, Option(min=10, max=500, help="Side of the character's patch of paper.")] = 70.0
    sheet: NewSheet = None
    armed: Arm = False
    tui: Tui = None


@dataclass(frozen=True, slots=True)
class DemoRequest:
    """Press, calibrate, press again and validate on the loopback rig. Run it again to continue where it stopped."""

    out: Annotated[Path, Option(help="Folder for everything that the demo makes.")] = Path("demo-run")
    full: Annotated[bool, Option("--full", help="Press more and write a character, to fill all tables.")] = False
    brush: Annotated[Path, Option(help="The simulated brush: `table2`, `loopback`, or a brush.toml.")] = Path("table2")
    show: Annotated[bool, Option("--open", help="Open the report in the browser at the end.")] = False
    verbose: Annotated[bool, Option("--verbose", help="Show the steps' output instead of writing demo.log.")] = False
