"""`brushloop sessions ...`: what a scientist does with recordings. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.cli import care as cli_care
from sessions.cli import importing as cli_import
from sessions.cli import share as cli_share
from sessions.terminal import say

app = typer.Typer(help="Inspect, check, repair, import and export recordings.", no_args_is_help=True)


@app.command("list")
def list_(
    root: Annotated[Path, typer.Argument(help="Folder that holds sessions.")] = Path("sessions"),
) -> None:
    """List the sessions under a folder: closed, imported, or still open."""
    from rich.table import Table

    from sessions.summary import summaries

    table = Table("session", "state", "source", "strokes", "file")
    for row in summaries(root):
        table.add_row(row.session_id, row.state, row.source, str(row.strokes), row.file)
    say(table)


for command in (cli_care.show, cli_care.verify, cli_care.repair, cli_care.close, cli_share.merge, cli_share.export):
    app.command()(command)
app.command("import")(cli_share.import_)
app.command("import-sequence")(cli_import.import_sequence)
app.command("import-scans")(cli_import.import_scans)
