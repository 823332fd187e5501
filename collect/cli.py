"""`brushloop collect`: runs a protocol, with the Textual screen or with a progress bar."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def collect(
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    protocol: Annotated[Path, typer.Option(help="What to do: depths, tilts, repeats.")],
    out: Annotated[Path, typer.Option(help="Folder that holds sessions.")] = Path("sessions"),
    new: Annotated[bool, typer.Option("--new", help="Start a new session though one is open.")] = False,
    sheet: Annotated[
        int | None,
        typer.Option(min=1, help="Sheet N of the session is in: confirms a fresh one. Repeating it is safe."),
    ] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Let real hardware move.")] = False,
    tui: Annotated[
        bool | None, typer.Option("--tui/--no-tui", help="Screen; by default where there is a terminal.")
    ] = None,
) -> None:
    """Collect strokes. Ctrl-C stops the arm; the same command goes on where it stopped."""
    import sys

    from collect.engine import Engine
    from collect.opening import Opening, find_resumable, open_store
    from collect.plan import check_plan
    from drivers.clock import HostClock

    opening = Opening.load(out, config, protocol, new=new, sheet=sheet, armed=arm)
    check_plan(config, protocol, opening.rig, opening.protocol)
    resume = find_resumable(opening)
    clock = HostClock()
    engine = Engine(opening.rig, opening.protocol, lambda rig: open_store(opening, resume, rig, clock), clock)
    if tui if tui is not None else sys.stdin.isatty() and sys.stdout.isatty():
        from collect.tui.app import run_screen

        run_screen(engine)
    else:
        from collect.headless import run_headless

        run_headless(engine)


def doctor(
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a device.")] = False,
) -> None:
    """Ask every configured device who it is and what is wrong. Powers nothing and moves nothing."""
    import asyncio
    import json
    import sys

    from collect.config import load_rig
    from collect.doctor import examine
    from drivers.clock import HostClock

    findings = asyncio.run(examine(load_rig(config), HostClock()))
    if as_json:
        sys.stdout.writelines(json.dumps(finding.as_json()) + "\n" for finding in findings)
    else:
        import rich

        from collect.doctor_table import doctor_table

        rich.print(doctor_table(findings))
    if not all(finding.well for finding in findings):
        raise typer.Exit(4)
