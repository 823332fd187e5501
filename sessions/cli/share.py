"""`brushloop sessions import|merge|export`: in and out of the store. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.cli.importing import Length, Radius
from sessions.terminal import say


def import_(
    folder: Annotated[Path, typer.Argument(help="Folder of photographs.")],
    csv: Annotated[Path, typer.Option(help="Table with a `file` column, px_per_mm, and one column per parameter.")],
    out: Annotated[Path | None, typer.Option(help="New session folder; sessions/<folder's name> by default.")] = None,
    kind: Annotated[str, typer.Option(help="press (vertical presses) or drag (strokes that travel).")] = "drag",
    px_per_mm: Annotated[float | None, typer.Option(help="Scale, where the table does not tell it.")] = None,
    licence: Annotated[str, typer.Option(help="Licence of the photographs, kept in the recording.")] = "",
    origin: Annotated[str, typer.Option(help="Where they come from, kept in the recording.")] = "",
    brush: Annotated[str, typer.Option(help="What is known of the brush.")] = "",
    brush_radius_mm: Radius = None,
    brush_length_mm: Length = None,
) -> None:
    """Turn a folder of photographs with a parameter table into a session that every later command accepts."""
    import time
    from importlib.metadata import version

    from sessions.imports.photographs import ImportOptions, import_photographs

    options = ImportOptions(kind, px_per_mm, licence, origin, brush, brush_radius_mm, brush_length_mm)
    target = out or Path("sessions") / folder.resolve().name
    path = import_photographs(folder, csv, target, options, f"brushloop {version('brushloop')}", time.time_ns)
    say(f"Imported into {path}")


def merge(
    out: Annotated[Path, typer.Argument(help="The new .mcap file.")],
    parts: Annotated[list[Path], typer.Argument(help="Two or more session folders or .mcap files, in order.")],
) -> None:
    """Merge recordings of one setup (brush, ink, paper, rig) into one file that says where each part came from.

    The camera must not have been moved between them: the merged file is calibrated as one.
    """
    from sessions.combine import combine

    say(f"Merged into {combine(parts, out)}")


def export(
    session: Annotated[Path, typer.Argument(help="A closed session's folder, or an .mcap file.")],
    out: Annotated[Path, typer.Argument(help="The new folder.")],
    kind: Annotated[str, typer.Option("--format", help="png (images and CSV), npz, or parquet.")] = "png",
) -> None:
    """Export strokes and poses: images with CSV, NumPy arrays, or Parquet that Hugging Face `datasets` loads."""
    from sessions.export.export import export as write

    say(f"Exported into {write(session, out, kind)}")
