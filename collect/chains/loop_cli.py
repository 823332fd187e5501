"""`brushloop loop SESSION`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say


def loop(
    session: Annotated[Path, typer.Argument(help="The session whose presses are recovered and made again.")],
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    out: Annotated[Path | None, typer.Option(help="Folder for what the loop makes; <session>/loop by default.")] = None,
    fit: Annotated[Path | None, typer.Option(help="Brush fit; the one in use, or made, by default.")] = None,
    repeats: Annotated[int, typer.Option(min=1, max=100, help="How often each is pressed again.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Of the order.")] = 1,
    sheet: Annotated[int | None, typer.Option(min=1, help="Sheet N of the new session is in, as for collect.")] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Let real hardware move.")] = False,
    tui: Annotated[bool | None, typer.Option("--tui/--no-tui", help="Screen; by default where there is one.")] = None,
) -> None:
    """Recover every press from its image, press it again, compare. The same command goes on where it stopped."""
    from collect.chains.commands import CommandFailed
    from collect.chains.loop import LoopRequest, run_loop
    from sessions.reader import Recording

    options = ["--arm"] if arm else []
    options += [] if sheet is None else ["--sheet", str(sheet)]
    options += [] if tui is None else ["--tui" if tui else "--no-tui"]
    folder = out if out is not None else Recording(session).path.parent / "loop"
    try:
        run_loop(LoopRequest(session, config, folder, fit, repeats, seed, tuple(options)), say)
    except CommandFailed as error:
        raise typer.Exit(error.exit_code) from None  # the command has said why
