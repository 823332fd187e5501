"""`brushloop collect`: runs a protocol, on the Textual screen or with a progress bar; `collect plan` only walks it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from sessions.terminal import say

if TYPE_CHECKING:
    from collect.engine.engine import Engine
    from collect.engine.opening import Opening

app = typer.Typer(invoke_without_command=True, pretty_exceptions_enable=False)


@app.callback()
def collect(
    ctx: typer.Context,
    config: Annotated[Path | None, typer.Option(help="The rig: addresses, frames, limits; required.")] = None,
    protocol: Annotated[Path | None, typer.Option(help="What to do; required.")] = None,
    out: Annotated[Path, typer.Option(help="Folder that holds sessions.")] = Path("sessions"),
    new: Annotated[bool, typer.Option("--new", help="Start a new session though one is open.")] = False,
    sheet: Annotated[
        int | None,
        typer.Option(min=1, help="Sheet N of the session is in: confirms a fresh one. Repeating it is safe."),
    ] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Let real hardware move.")] = False,
    dry_run: Annotated[
        float | None,
        typer.Option(help="Only move, lifted by so many mm: nothing is pressed, dipped or kept."),
    ] = None,
    tui: Annotated[
        bool | None, typer.Option("--tui/--no-tui", help="Screen; by default where there is a terminal.")
    ] = None,
    set_up: Annotated[
        bool, typer.Option("--set-up", help="On the screen: accept what each set-up step measured, or measure again.")
    ] = False,
    preview: Annotated[
        Literal["cells", "auto", "off"],
        typer.Option(help="Camera on the screen: half-cells; auto: pixels where the terminal has them."),
    ] = "cells",
    live: Annotated[bool, typer.Option("--live", help="Let a Foxglove viewer on this machine look on.")] = False,
    live_port: Annotated[int, typer.Option(min=0, max=65535, help="Where it listens; 0: any.")] = 8765,
) -> None:
    """Collect strokes. Ctrl-C stops the arm; the same command goes on where it stopped."""
    if ctx.invoked_subcommand is not None:
        return
    if config is None or protocol is None:
        ctx.fail(f"Missing option '{'--config' if config is None else '--protocol'}'.")
    import sys

    from collect import start
    from collect.engine.live import LiveView
    from collect.engine.opening import Opening

    on_screen = tui if tui is not None else sys.stdin.isatty() and sys.stdout.isatty()
    if dry_run is not None:
        start.dry_run(config, protocol, dry_run, armed=arm, on_screen=on_screen)
        return
    opening = Opening.load(out, config, protocol, new=new, sheet=sheet, armed=arm)
    given_up = start.start(
        opening,
        on_screen=on_screen,
        live=LiveView(live_port) if live else None,
        guided=set_up and on_screen,
        preview=preview,
    )
    if given_up:
        say(f"finished; {given_up} strokes came out badly every time and were left out", err=True)
        raise typer.Exit(3)


def browse() -> None:
    """Open the start screen: `brushloop` without arguments. The screen is up before the engine is imported."""
    from collect.tui.browser import Paths, SessionBrowser
    from collect.tui.runner import run_browser

    def engine_for(opening: Opening, *, watched: bool, guided: bool, preview: bool) -> Engine:
        from collect import start

        return start.engine_for(opening, watched=watched, guided=guided, preview=preview)

    run_browser(SessionBrowser(Paths(), engine_for))


@app.command()
def plan(
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    protocol: Annotated[Path, typer.Option(help="What would be done.")],
    picture: Annotated[
        Path | None, typer.Option(help="Draw the sheets into this file: .png, .svg, .pdf or .jpg.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object instead of tables.")] = False,
    arm: Annotated[
        bool, typer.Option("--arm", help="As it is run with --arm: with the self-check; moves nothing.")
    ] = False,
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask the arm's controller whether it reaches every pose; moves nothing.")
    ] = False,
) -> None:
    """Walk a protocol without moving: limits, sheets, dips, ink, time, and a picture of the sheets."""
    import asyncio
    import json

    from collect.planning.limits import all_poses, check_protocol
    from collect.planning.plan_table import plan_table
    from collect.planning.summary import make_plan
    from collect.protocols.files import load_protocol
    from collect.rig.config import load_rig
    from collect.rig.paper import PaperPlane

    if picture is not None:
        from collect.planning.picture import check_picture

        check_picture(picture)
    rig, wanted = load_rig(config), load_protocol(protocol)
    if arm or not rig.robot.on_this_machine:
        rig = rig.settled(arm)
    check_protocol(config, protocol, rig, wanted)
    made = make_plan(rig, wanted)
    asked = None
    if ask:
        from collect.planning.asking import ask_reach

        poses = all_poses(rig, wanted, PaperPlane(rig.paper.touch_z_mm), every_cell=True)
        asked = asyncio.run(ask_reach(config, rig, poses))
    if picture is not None:
        from collect.planning.picture import draw_plan

        draw_plan(rig, wanted, made, picture)
    if as_json:
        say(json.dumps(made.as_json() | {"poses_in_reach": asked}))
        return
    say(plan_table(made))
    if asked is not None:
        say(f"The controller finds joints for all {asked} poses.")


def doctor(
    config: Annotated[Path, typer.Option(help="The rig: addresses, frames, limits.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a device.")] = False,
) -> None:
    """Ask every configured device who it is and what is wrong. Powers nothing and moves nothing."""
    import asyncio
    import json

    from collect.rig.config import load_rig
    from collect.rig.doctor import examine
    from drivers.clock import HostClock

    findings = asyncio.run(examine(load_rig(config), HostClock()))
    if as_json:
        say(*(json.dumps(finding.as_json()) for finding in findings))
    else:
        from collect.rig.doctor import doctor_table

        say(doctor_table(findings))
    if not all(finding.well for finding in findings):
        raise typer.Exit(4)
