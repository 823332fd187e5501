"""`brushloop write 字 --config rig.toml`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say


def write(
    what: Annotated[str, typer.Argument(help="Characters (字 子 永 are shipped), or a .csv or .json trajectory.")],
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    out: Annotated[Path, typer.Option(help="Folder for the plan and the report.")] = Path("written"),
    sessions: Annotated[Path, typer.Option(help="Folder that holds sessions.")] = Path("sessions"),
    count: Annotated[int, typer.Option(min=1, max=1000, help="How often each is written.")] = 10,
    learn: Annotated[int, typer.Option(min=0, max=20, help="Rounds of correcting the plan by its own ink first.")] = 0,
    learn_count: Annotated[int, typer.Option(min=1, max=100, help="How often each is written in such a round.")] = 2,
    data: Annotated[Path | None, typer.Option(help="hanzi-writer folder or makemeahanzi graphics.txt.")] = None,
    reference: Annotated[list[str] | None, typer.Option(help="字=picture.png: compare with this picture.")] = None,
    cell_mm: Annotated[float, typer.Option(min=10, max=500, help="Side of the character's paper cell.")] = 70.0,
    speed_mm_s: Annotated[float, typer.Option(min=1, max=100, help="Of the tip.")] = 15.0,
    sheet: Annotated[int | None, typer.Option(min=1, help="Sheet N of the new session is in, as for collect.")] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Let real hardware move.")] = False,
    tui: Annotated[bool | None, typer.Option("--tui/--no-tui", help="Screen; by default where there is one.")] = None,
) -> None:
    """Plan characters, write them on the rig, compare with simulation and reference. The same command goes on."""
    from collect.chains.commands import CommandFailed
    from collect.chains.writing import Writing, WritingRequest

    plan_options = ["--cell-mm", str(cell_mm), "--speed-mm-s", str(speed_mm_s)]
    plan_options += [] if data is None else ["--data", str(data)]
    options = ["--arm"] if arm else []
    options += [] if tui is None else ["--tui" if tui else "--no-tui"]
    request = WritingRequest(
        what,
        config,
        out,
        sessions,
        count,
        learn,
        learn_count,
        sheet,
        tuple(plan_options),
        tuple(reference or ()),
        tuple(options),
    )
    try:
        Writing(request, say).run()
    except CommandFailed as error:
        raise typer.Exit(error.exit_code) from None  # the command has said why
