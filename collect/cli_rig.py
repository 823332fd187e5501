"""The commands of `brushloop rig`: teach a rig, look at its rig.toml and check it.

Imports wait until a command runs, so that `--help` loads nothing heavy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from brushloop.collect.tui.teach_app import ScreenGuide

app = typer.Typer(
    help="Teach a rig on its first day; show and check its rig.toml.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
RigFile = Annotated[Path, typer.Argument(help="The rig: addresses, frames, limits.")]


Arm = Annotated[bool, typer.Option("--arm", help="Let the arm move where a step needs it; a key confirms each time.")]


@app.command()
def new(
    rig: Annotated[Path, typer.Argument(help="The rig.toml to make; what is taught is kept beside it.")] = Path(
        "rig.toml"
    ),
    arm: Arm = False,
) -> None:
    """Guide you through the first day, from an unboxed arm to a rig.toml. Run it again to resume."""
    _teach(rig, None, arm=arm)


@app.command()
def teach(
    step: Annotated[str, typer.Argument(help="arm, camera, tip, sheet, places, brush, force, limits or proof.")],
    rig: Annotated[Path, typer.Option(help="The rig.toml; what was taught is kept beside it.")] = Path("rig.toml"),
    arm: Arm = False,
) -> None:
    """Teach one step again. Only its values change, and those that depend on them; the changes are listed."""
    _teach(rig, step, arm=arm)


def _teach(rig: Path, step: str | None, *, arm: bool) -> None:
    import sys

    from brushloop.collect.errors import ConfigError
    from brushloop.collect.tui.teach_app import run_teaching
    from brushloop.drivers.host import HostClock

    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ConfigError("rig", "", "a rig is taught on a screen: run this command in a terminal")

    async def work(guide: ScreenGuide) -> Path | None:
        from brushloop.collect.teach.day import Day
        from brushloop.collect.teach.wizard import Wizard

        wizard = Wizard(Day(guide, rig, HostClock(), armed=arm))
        return await (wizard.run() if step is None else wizard.again(step))

    if (written := run_teaching(work, str(rig))) is not None:
        say(f"{written} is written, with how each value was obtained. Next: brushloop rig check {written}")


@app.command()
def show(
    rig: RigFile,
    picture: Annotated[Path | None, typer.Option(help="Draw it from above: .png, .svg, .pdf or .jpg.")] = None,
) -> None:
    """Show a rig: its box of limits and every place that the tip goes to. Asks no device."""
    from brushloop.collect.rig.config import load_rig
    from brushloop.collect.rig.show import check_picture, draw_rig, rig_table

    if picture is not None:
        check_picture(picture)
    config = load_rig(rig)
    if picture is not None:
        draw_rig(config, picture)
    say(rig_table(config))


@app.command()
def check(
    rig: RigFile, as_json: Annotated[bool, typer.Option("--json", help="One JSON object instead of text.")] = False
) -> None:
    """Report which values of a rig.toml are plausible, contradict each other, or were not measured. Asks no device.

    Ends with code 5 if values contradict each other.
    """
    import json
    from dataclasses import asdict

    from brushloop.collect.rig.check import check_page, check_rig, contradictions
    from brushloop.collect.rig.config import load_rig
    from brushloop.collect.teach.store import TaughtFile, gaps

    checks = [*check_rig(load_rig(rig)), *gaps(TaughtFile(rig).load())]
    if as_json:
        say(json.dumps({"contradictions": contradictions(checks), "checks": [asdict(check) for check in checks]}))
    else:
        say(check_page(checks))
    if contradictions(checks):
        raise typer.Exit(5)
