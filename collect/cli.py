"""The commands `collect`, `collect plan`, `doctor` and those of `rig`, and the start screen.

Imports wait until a command runs, so that `--help` loads nothing heavy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.commands import PathOrCommand, command
from brushloop.calibrate.files import check_target
from brushloop.collect.engine import PROTOCOL_FILE, RIG_FILE, CollectRequest, Rig
from brushloop.sessions.terminal import say

app = typer.Typer(
    cls=PathOrCommand,
    help="Collect strokes (`brushloop collect --protocol protocol.toml`), or only plan them.",
    pretty_exceptions_enable=False,
)
rig_app = typer.Typer(
    help="Teach a rig on its first day; show and check its rig.toml.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

PICTURES = (".png", ".svg", ".pdf", ".jpg")
"""Endings of a picture's file, which determine its format."""
RigFile = Annotated[Path, typer.Argument(help="The rig.toml: addresses, frames and limits of the rig.")]
StepArm = Annotated[bool, typer.Option("--arm", help="Let the arm move in steps that need it, once you confirm.")]


app.command("strokes")(command(CollectRequest, "collect.start:run", lambda run, request: run(request)))


def browse() -> None:
    """Open the start screen: `brushloop` without arguments. The screen appears before the engine is imported."""
    from brushloop.collect.tui.app import OperatorApp, run_app
    from brushloop.collect.tui.start_screen import SessionBrowser

    browser = SessionBrowser()
    run_app(OperatorApp(browser.engine, browser=browser))


@app.command()
def plan(
    config: Rig = RIG_FILE,
    protocol: Annotated[Path, typer.Option(help="The protocol to plan.")] = PROTOCOL_FILE,
    picture: Annotated[Path | None, typer.Option(help="Draw the sheets as a .png, .svg, .pdf or .jpg.")] = None,
    arm: Annotated[bool, typer.Option("--arm", help="Plan as for a run with --arm: with the self-check.")] = False,
    ask: Annotated[bool, typer.Option("--ask", help="Ask the controller if the arm reaches every pose.")] = False,
) -> None:
    """Check a protocol without moving the arm: print limits, sheets, dips, ink and time, and draw the sheets."""
    import asyncio

    from brushloop.collect.plan import draw_plan, make_plan, plan_table
    from brushloop.collect.protocols.config import load_protocol
    from brushloop.collect.rig.config import load_rig
    from brushloop.collect.rig.paper import PaperPlane
    from brushloop.collect.walk import all_poses, ask_reach, check_protocol

    if picture is not None:
        check_target(picture, *PICTURES)
    rig, wanted = load_rig(config).settled(arm), load_protocol(protocol)
    check_protocol(config, protocol, rig, wanted)
    planned = make_plan(rig, wanted)
    say(plan_table(planned), f"Every pose is within the limits of {config}.")
    if picture is not None:
        draw_plan(rig, wanted, planned, picture)
        say(f"The sheets are drawn in {picture}")
    if ask:
        poses = all_poses(rig, wanted, PaperPlane(rig.paper.touch_z_mm))
        say(f"The controller finds joint angles for all {asyncio.run(ask_reach(config, rig, poses))} poses.")


def doctor(
    config: Rig = RIG_FILE,
    report: Annotated[Path | None, typer.Option(help="Write a bug report without secrets to this .zip.")] = None,
) -> None:
    """Ask every configured device for its identity and its faults. Powers nothing and moves nothing."""
    import asyncio

    from brushloop.collect.errors import ConfigError
    from brushloop.collect.rig.config import load_rig

    if report is not None:
        from brushloop.collect.commission.arm import ADDRESS, write_first_report
        from brushloop.collect.commission.visit import Notebook

        check_target(report, ".zip")
        if report.exists():
            raise ConfigError("--report", "", f"{report} exists and is not overwritten: choose another name")
        if not config.exists() and ADDRESS in (notebook := Notebook.load(config)).values:
            asyncio.run(write_first_report(report, notebook))
            say(f"There is no {config} yet. {report} holds the values so far and the arm's answers. Read it first.")
            return
    rig = load_rig(config)

    from brushloop.collect.rig.doctor import doctor_table, examine, write_report  # slow to import
    from brushloop.drivers.host import Clock

    findings = asyncio.run(examine(rig, Clock()))
    say(doctor_table(findings))
    if report is not None:
        asyncio.run(write_report(report, rig.model_dump(mode="json"), rig.robot, findings))
        say(f"{report} holds every device's answers. Read it before you send it.")
    if not all(finding.well for finding in findings):
        raise typer.Exit(4)


@rig_app.command()
def new(
    rig: Annotated[Path, typer.Argument(help="The rig.toml to write; values taught are saved beside it.")] = RIG_FILE,
    arm: StepArm = False,
) -> None:
    """Guide you through the first day, from an unboxed arm to a rig.toml. Run it again to resume."""
    _commission(rig, None, arm=arm)


@rig_app.command()
def teach(
    step: Annotated[str, typer.Argument(help="arm, camera, tip, sheet, places, brush, force, limits or proof.")],
    rig: Annotated[Path, typer.Option(help="The rig.toml; the values of the first day are kept beside it.")] = RIG_FILE,
    arm: StepArm = False,
) -> None:
    """Repeat one step of the first day. Only its values, and those that depend on them, change; changes are listed."""
    _commission(rig, step, arm=arm)


def _commission(rig: Path, step: str | None, *, arm: bool) -> None:
    import sys

    from brushloop.collect.commission.visit import Visit
    from brushloop.collect.errors import ConfigError
    from brushloop.collect.tui.commission_app import run_commission
    from brushloop.drivers.host import Clock

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError("rig", "", "the first-day guide needs a screen: run this command in a terminal")

    visit = Visit(rig, Clock(), armed=arm)

    async def work() -> Path | None:
        from brushloop.collect.commission.wizard import Wizard

        wizard = Wizard(visit)
        return await (wizard.run() if step is None else wizard.again(step))

    if (written := run_commission(visit, work)) is not None:
        say(f"{written} is written; it says how each value was obtained. Next: brushloop rig check {written}")


@rig_app.command()
def show(
    rig: RigFile = RIG_FILE,
    picture: Annotated[Path | None, typer.Option(help="Draw the rig from above as a .png, .svg, .pdf or .jpg.")] = None,
) -> None:
    """Show a rig: the limits of the tip and every place that it goes to. No device is asked."""
    from brushloop.collect.rig.check import draw_rig, rig_table
    from brushloop.collect.rig.config import load_rig

    if picture is not None:
        check_target(picture, *PICTURES)
    config = load_rig(rig)
    say(rig_table(config))
    if picture is not None:
        draw_rig(config, picture)
        say(f"The rig is drawn in {picture}")


@rig_app.command()
def check(rig: RigFile = RIG_FILE) -> None:
    """Report which values of a rig.toml are plausible, contradict each other, or were not measured. No device is asked.

    Ends with code 5 if values contradict each other.
    """
    from brushloop.collect.commission.visit import Notebook, gaps
    from brushloop.collect.rig.check import check_page, check_rig
    from brushloop.collect.rig.config import load_rig

    checks = [*check_rig(load_rig(rig)), *gaps(Notebook.load(rig))]
    say(check_page(checks))
    if any(check.verdict == "contradicts" for check in checks):
        raise typer.Exit(5)
