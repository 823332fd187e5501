"""`brushloop validate SESSION...`, `brushloop validate diff A B` and `brushloop validate captures`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say

app = typer.Typer(help="Compare every stroke model with every captured stroke (`brushloop validate SESSION...`).")
"""Mounted as a `PathOrCommand`."""


@app.command("sessions")
def validate(
    session: Annotated[list[str], typer.Argument(help="Sessions: folders, .mcap files, or URLs with a checksum.")],
    model: Annotated[list[str] | None, typer.Option(help="Only these models; all by default.")] = None,
    generator: Annotated[list[Path] | None, typer.Option(help="A trained generator.safetensors.")] = None,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    fit: Annotated[Path | None, typer.Option(help="Brush fit, the one in use by default; of drags, a dragfit.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the report; <session>/validation by default.")] = None,
    gate: Annotated[
        list[str] | None, typer.Option(help="Like 'csim_avg>=0.90', quoted; exit code 5 if missed.")
    ] = None,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Other lambdas, and similarity by number of fitted presses.")
    ] = False,
    curves: Annotated[list[str] | None, typer.Option(help="NAME=FOLDER of a training, for figures 9 and 12.")] = None,
    held_out: Annotated[bool, typer.Option(help="Fit to other cells, each cell left out in turn.")] = True,
    scheduler: Annotated[str, typer.Option(help="An existing Dask cluster, as tcp://host:8786.")] = "",
    workers: Annotated[int | None, typer.Option(min=1, max=1024, help="Threads; all cores by default.")] = None,
) -> None:
    """Compare every model with every captured stroke; run the same command again to resume."""
    import sys

    from brushloop.calibrate.compare.place import Field
    from brushloop.calibrate.validate.command import Request, check
    from brushloop.calibrate.validate.command import validate as run
    from brushloop.sessions.terminal import shown

    request = Request(
        places=tuple(session),
        command=" ".join(["brushloop", *sys.argv[1:]]),
        models=tuple(model or ()),
        view=Field(mm_per_px=mm_per_px),
        fit=fit,
        generators=tuple(generator or ()),
        curves=tuple(curves or ()),
        gates=tuple(gate or ()),
        ablations=ablations,
        held_out=held_out,
        out=out,
        scheduler=scheduler,
        workers=workers,
    )
    with shown() as progress:
        output = run(request, progress)
    say(*output.lines())
    check(output, request)


@app.command()
def diff(
    before: Annotated[Path, typer.Argument(help="A report.json, or a session that was validated.")],
    after: Annotated[Path, typer.Argument(help="A report.json or session to compare it with.")],
) -> None:
    """Show what got better or worse between two reports, sessions or software versions, by a paired test."""
    from brushloop.calibrate.validate.diff import compare

    say(*compare(before, after).lines())


@app.command()
def captures(
    session: Annotated[list[str], typer.Argument(help="Sessions of presses.")],
    generator: Annotated[Path, typer.Option(help="The generator.safetensors to tune.")],
    out: Annotated[Path, typer.Option(help="The file for `brushloop train tune`.")] = Path("captures.safetensors"),
) -> None:
    """Write captured presses in the format that `brushloop train tune` reads."""
    from brushloop.calibrate.files import check_target
    from brushloop.calibrate.validate.command import one_source, open_session
    from brushloop.calibrate.validate.tuning import align_captures, write_captures

    check_target(out, ".safetensors", generator)
    opened = [open_session(place) for place in session]
    one_source(opened)
    aligned = align_captures(opened, generator)
    write_captures(aligned, out)
    for name, why in aligned.left_out:
        say(f"left out: {name}: {why}")
    say(f"{len(aligned.images)} presses ({aligned.source}): {out}")
