"""`brushloop fit`: fit a stroke model to one brush. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from brushloop.calibrate.drags.artefact import DragArtefact
    from brushloop.calibrate.drags.captures import Drawn

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

    from brushloop.calibrate.fit.command import FitRequest, fit_presses
    from brushloop.sessions.terminal import shown

    request = FitRequest(session, mm_per_px or MM_PER_PX, calibration, reference)
    with shown() as progress:
        fitted = fit_presses(request, progress)
    say(*fitted.lines())


def _fit_drags(
    session: Path, mm_per_px: float | None, calibration: Path | None, prior: Path | None, strokes: int | None
) -> None:
    from brushloop.calibrate.artefact import load_artefact, put_to_use
    from brushloop.calibrate.drags.artefact import DragArtefact
    from brushloop.calibrate.drags.captures import read_drags
    from brushloop.calibrate.drags.run import FOLDER, fit_drawn, refit_drawn
    from brushloop.sessions.recording import Recording
    from brushloop.sessions.terminal import shown

    before = load_artefact(prior, DragArtefact) if prior is not None else None
    scale = mm_per_px or (before.mm_per_px if before is not None else DRAG_MM_PER_PX)
    with shown() as progress:
        drawn = read_drags(session, scale, calibration, progress)
        if before is not None:
            fitted = refit_drawn(drawn, before, str(prior), strokes if strokes is not None else len(drawn.ink))
        else:
            fitted = fit_drawn(drawn, progress)
    say(*_drag_tables(drawn, fitted.artefact))
    say(f"Fit: {put_to_use(fitted.artefact, Recording(session).path.parent, FOLDER)}")


def _drag_tables(drawn: Drawn, artefact: DragArtefact) -> Iterator[object]:
    from rich.table import Table

    from brushloop.calibrate.drags.report import ends_sentence
    from brushloop.calibrate.report import source_label, source_note

    label = source_label(drawn.header.source, [drawn.header.brush])
    yield (
        f"{source_note(drawn.header.source, drawn.header.brush)}; "
        f"{artefact.strokes} dragged strokes in {artefact.images} images; condition number {artefact.condition:.3g}"
    )
    for name, why in drawn.refused:
        yield f"left out: {name}: {why}"
    for name, flags in zip(drawn.stroke_ids, drawn.flags, strict=True):
        if flags:
            yield f"counts less: {name}: {'; '.join(flags)}"
    if drawn.commands is not None:
        yield ends_sentence(drawn.ends)
    if artefact.prior:
        adapted = ", ".join(artefact.refitted)
        yield f"The brush of {artefact.prior_session} (fit {artefact.prior}), with these parameters adapted: {adapted}."
    out = Table("parameter", "fitted", "95 %", title=f"drag model, mm ({label})")
    for name, found in artefact.parameters.items():
        interval = "not determined" if found.low is None else f"{found.low:.3f} to {found.high:.3f}"
        if artefact.prior and name not in artefact.refitted:
            interval = "as before"
        out.add_row(name, f"{found.value:.3f}", interval)
    yield out
    if artefact.kept is not None:
        yield f"A pixel is ink above a probability of {artefact.ink_above:g}, chosen by the training strokes."
    if artefact.held_out:
        title = f"a fifth left out in turn, where the command put it, percent ({label})"
        out = Table("model", "n", "CSIM", "IoU", title=title)
        for name, score in artefact.held_out.items():
            out.add_row(name, str(score.images), f"{score.csim_percent:.2f}", f"{score.iou_percent:.2f}")
        yield out
    elif not artefact.prior:
        yield "Fewer than five images: too few to leave some out."
