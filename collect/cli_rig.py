"""The commands of `brushloop rig`: look at a rig.toml and check it.

Imports wait until a command runs, so that `--help` loads nothing heavy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say

app = typer.Typer(
    help="Teach a rig on its first day, look at its rig.toml, check it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
RigFile = Annotated[Path, typer.Argument(help="The rig: addresses, frames, limits.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object instead of text.")]


@app.command()
def show(
    rig: RigFile,
    picture: Annotated[
        Path | None, typer.Option(help="Draw it from above and from the side: .png, .svg, .pdf or .jpg.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show a rig: its box of limits and every place that the tip goes to. Asks no device."""
    import json

    from collect.rig.config import load_rig
    from collect.rig.drawing import check_picture
    from collect.rig.show import rig_json, rig_table

    if picture is not None:
        check_picture(picture)
    config = load_rig(rig)
    if picture is not None:
        from collect.rig.picture import draw_rig

        draw_rig(config, picture)
    say(json.dumps(rig_json(config)) if as_json else rig_table(config))


@app.command()
def check(rig: RigFile, as_json: Json = False) -> None:
    """Say what in a rig.toml is plausible, what contradicts what, and what was not measured. Asks no device.

    Ends with code 5 if anything contradicts something.
    """
    import json

    from collect.rig.check import check_page, check_rig, contradictions
    from collect.rig.config import load_rig

    checks = check_rig(load_rig(rig))
    if as_json:
        say(json.dumps({"contradictions": contradictions(checks), "checks": [c.as_json() for c in checks]}))
    else:
        say(check_page(checks))
    if contradictions(checks):
        raise typer.Exit(5)
