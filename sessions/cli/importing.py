"""`brushloop sessions import-sequence|import-scans`: photographs that come otherwise than one stroke each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say

Out = Annotated[Path | None, typer.Option(help="New session folder; sessions/<folder's name> by default.")]
Licence = Annotated[str, typer.Option(help="Licence of the photographs, kept in the recording.")]
Origin = Annotated[str, typer.Option(help="Where they come from, kept in the recording.")]
Brush = Annotated[str, typer.Option(help="What is known of the brush.")]
Radius = Annotated[float | None, typer.Option(min=0.5, max=50.0, help="R of the brush; 6 where it is not told.")]
Length = Annotated[float | None, typer.Option(min=5.0, max=500.0, help="L of the brush; 48 where it is not told.")]


def import_sequence(
    folder: Annotated[Path, typer.Argument(help="Folder of frames of one page.")],
    csv: Annotated[Path | None, typer.Option(help="Table with `before`, `after` and what was commanded.")] = None,
    page_mm: Annotated[str, typer.Option(help="Width x height of what a frame shows, as 203.2x279.4.")] = "",
    px_per_mm: Annotated[float | None, typer.Option(help="Scale, instead of --page-mm.")] = None,
    out: Out = None,
    licence: Licence = "",
    origin: Origin = "",
    brush: Brush = "",
) -> None:
    """Import a page that was photographed after every stroke; without --csv the frames are taken by name."""
    import time
    from importlib.metadata import version

    from sessions.errors import InputError
    from sessions.imports.photographs import ImportOptions
    from sessions.imports.sequence import import_sequence as run

    page: tuple[float, float] | None = None
    if page_mm:
        try:
            width, height = (float(part) for part in page_mm.lower().split("x"))
        except ValueError:
            raise InputError(folder, f"--page-mm is {page_mm!r}, expected a size like 203.2x279.4") from None
        if not (1.0 <= width <= 1e5 and 1.0 <= height <= 1e5):
            raise InputError(folder, f"--page-mm is {page_mm!r}, allowed 1 to 100000 mm")
        page = (width, height)
    options = ImportOptions("drag", px_per_mm, licence, origin, brush)
    target = out or Path("sessions") / folder.resolve().name
    path = run(folder, csv, target, options, f"brushloop {version('brushloop')}", time.time_ns, page)
    say(f"Imported into {path}")


def import_scans(
    folder: Annotated[Path, typer.Argument(help="Folder of scans.")],
    csv: Annotated[Path, typer.Option(help="Table as for `import`; with boxes and names where a scan holds many.")],
    dpi: Annotated[float | None, typer.Option(help="Of the scanner; what the files say by default.")] = None,
    kind: Annotated[str, typer.Option(help="press (vertical presses) or drag (strokes that travel).")] = "drag",
    out: Out = None,
    licence: Licence = "",
    origin: Origin = "",
    brush: Brush = "",
    brush_radius_mm: Radius = None,
    brush_length_mm: Length = None,
) -> None:
    """Import flatbed scans; the scale is their dpi, and a sheet is cut into strokes where the table has boxes."""
    import time
    from importlib.metadata import version

    from sessions.imports.photographs import ImportOptions
    from sessions.imports.scan import import_scans as run

    options = ImportOptions(kind, None, licence, origin, brush, brush_radius_mm, brush_length_mm)
    target = out or Path("sessions") / folder.resolve().name
    path = run(folder, csv, target, options, f"brushloop {version('brushloop')}", time.time_ns, dpi)
    say(f"Imported into {path}")
