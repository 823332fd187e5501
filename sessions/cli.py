"""`brushloop sessions ...`: what a scientist does with recordings. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Import and inspect recordings.", no_args_is_help=True)


@app.command("import")
def import_(
    folder: Annotated[Path, typer.Argument(help="Folder of photographs.")],
    csv: Annotated[Path, typer.Option(help="Table with a `file` column, px_per_mm, and one column per parameter.")],
    out: Annotated[Path | None, typer.Option(help="New session folder; sessions/<folder's name> by default.")] = None,
    kind: Annotated[str, typer.Option(help="press (vertical presses) or drag (strokes that travel).")] = "drag",
    px_per_mm: Annotated[float | None, typer.Option(help="Scale, where the table does not tell it.")] = None,
    licence: Annotated[str, typer.Option(help="Licence of the photographs, kept in the recording.")] = "",
    origin: Annotated[str, typer.Option(help="Where they come from, kept in the recording.")] = "",
    brush: Annotated[str, typer.Option(help="What is known of the brush.")] = "",
) -> None:
    """Turn a folder of photographs with a parameter table into a session that every later command accepts."""
    import time
    from importlib.metadata import version

    from sessions.importer import ImportOptions, import_photographs

    options = ImportOptions(kind, px_per_mm, licence, origin, brush)
    target = out or Path("sessions") / folder.resolve().name
    path = import_photographs(folder, csv, target, options, f"brushloop {version('brushloop')}", time.time_ns)
    typer.echo(f"Imported into {path}")


@app.command("list")
def list_(
    root: Annotated[Path, typer.Argument(help="Folder that holds sessions.")] = Path("sessions"),
) -> None:
    """List the sessions under a folder: closed, imported, or still open."""
    import rich
    from rich.table import Table

    from sessions.summary import summaries

    table = Table("session", "state", "source", "strokes", "file")
    for row in summaries(root):
        table.add_row(row.session_id, row.state, row.source, str(row.strokes), row.file)
    rich.print(table)
