"""`brushloop fit`: fit a stroke model to one brush. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say

DRAG_MM_PER_PX = 0.4
"""Scale of the images that drags are fitted to."""


def fit(
    session: Annotated[Path, typer.Argument(help="A session of presses: its folder or its .mcap file.")],
    mm_per_px: Annotated[
        float | None,
        typer.Option(min=0.1, max=1.0, help=f"Scale of the images; {MM_PER_PX:g}, with --drags {DRAG_MM_PER_PX:g}."),
    ] = None,
    calibration: Annotated[Path | None, typer.Option(help="Artefact; the one in use by default.")] = None,
    correction: Annotated[bool, typer.Option("--correction", help="Print the change of the zero touch.")] = False,
    reference: Annotated[Path | None, typer.Option(help="An earlier fit of this brush; for --correction.")] = None,
    drags: Annotated[
        bool, typer.Option("--drags", help="Fit bristle lag to drags; writes dragfit/<hash>.json.")
    ] = False,
    prior: Annotated[
        Path | None, typer.Option(help="With --drags: a dragfit of this brush, whose place and width are adapted.")
    ] = None,
    strokes: Annotated[
        int | None, typer.Option(min=1, help="With --prior: only this many strokes, as different as possible.")
    ] = None,
) -> None:
    """Fit the stroke model to a session's presses; writes an immutable brushfit/<hash>.json and its page."""
    if (prior is not None and not drags) or (strokes is not None and prior is None):
        raise typer.BadParameter("--prior needs --drags, and --strokes needs --prior")
    if correction != (reference is not None):
        raise typer.BadParameter("--correction and --reference go together: ink alone does not show the zero touch")
    if drags:
        if correction:
            raise typer.BadParameter("--correction and --reference are for presses, not for --drags")
        _fit_drags(session, mm_per_px, calibration, prior, strokes)
        return

    from brushloop.calibrate.fit.brush import FitRequest, fit_presses
    from brushloop.sessions.terminal import shown

    request = FitRequest(session, mm_per_px or MM_PER_PX, calibration, reference)
    with shown() as progress:
        fitted = fit_presses(request, progress)
    say(*fitted.lines())


def _fit_drags(
    session: Path, mm_per_px: float | None, calibration: Path | None, prior: Path | None, strokes: int | None
) -> None:
    from brushloop.calibrate.artefact import load_artefact, put_to_use
    from brushloop.calibrate.drags.brush import FOLDER, DragArtefact, fit_drawn, refit_drawn
    from brushloop.calibrate.drags.captures import read_drags
    from brushloop.calibrate.drags.report import fit_lines
    from brushloop.sessions.recording import Recording
    from brushloop.sessions.terminal import shown

    before = load_artefact(prior, DragArtefact) if prior is not None else None
    scale = mm_per_px or (before.mm_per_px if before is not None else DRAG_MM_PER_PX)
    with shown() as progress:
        drawn = read_drags(session, scale, calibration, progress)
        if before is not None:
            artefact = refit_drawn(drawn, before, str(prior), strokes or len(drawn.stroke_ids))
        else:
            artefact = fit_drawn(drawn, progress)
    say(*fit_lines(drawn, artefact), f"Fit: {put_to_use(artefact, Recording(session).path.parent, FOLDER)}")
