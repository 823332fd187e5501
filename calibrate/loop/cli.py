"""`brushloop loop compare`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say


def compare(
    original: Annotated[Path, typer.Argument(help="The session whose strokes were pressed again.")],
    again: Annotated[Path, typer.Argument(help="The session of the replay protocol.")],
    fit: Annotated[
        Path | None, typer.Option(help="Brush fit that recovered depth and tilt; else CCD-BSM as published.")
    ] = None,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    out: Annotated[Path, typer.Option(help="Folder for loop.html, loop.png, loop.csv, loop.json.")] = Path("loop"),
) -> None:
    """Compare re-pressed strokes with their originals, and with the brush's own repeatability."""
    import sys

    from brushloop.calibrate.compare.field import Field
    from brushloop.calibrate.files import check_folder
    from brushloop.calibrate.loop.compare import compare_sessions
    from brushloop.calibrate.loop.report import PICTURE, summary, write_loop
    from brushloop.sessions.terminal import shown

    check_folder(out)
    with shown() as progress:
        loop = compare_sessions(original, again, fit, Field(mm_per_px=mm_per_px), progress)
    report = write_loop(loop, out, " ".join(["brushloop", *sys.argv[1:]]))
    for line in summary(loop):
        say(line)
    say(f"Picture: {out / PICTURE}", f"Report:  {report}")
