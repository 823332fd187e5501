"""`brushloop invert`. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say


def invert(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file; imports count as sessions.")],
    out: Annotated[Path, typer.Option(help="CSV to write; protocol-replay.toml goes beside it.")] = Path(
        "recovered.csv"
    ),
    model: Annotated[str, typer.Option(help="The stroke model to invert.")] = "ccd-bsm",
    fit: Annotated[Path | None, typer.Option(help="A brush fitted to captures, instead of --model.")] = None,
    lam: Annotated[float | None, typer.Option(min=0.1, max=10, help="lambda of CCD-BSM; pi when left out.")] = None,
    depth_range: Annotated[tuple[float, float], typer.Option(help="Depths to look for, mm.")] = (2.0, 30.0),
    tilt_range: Annotated[tuple[float, float], typer.Option(help="Tilts to look for, deg; at most 30.")] = (0.0, 30.0),
    anchor_sd: Annotated[float, typer.Option(min=0, max=5, help="Standard deviation of the touch point, mm.")] = 0.1,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = MM_PER_PX,
    calibration: Annotated[Path | None, typer.Option(help="Artefact; the one in use by default.")] = None,
    presses: Annotated[
        int | None, typer.Option(min=1, help="Only this many presses, spread evenly over the session.")
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="How many times the protocol presses each stroke.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the order in which the protocol presses.")] = 1,
) -> None:
    """Recover depth and tilt of every captured press; writes a CSV and a protocol that presses them again."""

    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_target
    from brushloop.sessions.recording import Recording

    check_target(out, ".csv")
    Recording(session)  # a wrong path is refused before the models are loaded, which takes seconds

    from brushloop.calibrate.compare.field import Field
    from brushloop.calibrate.invert.files import write_inversion
    from brushloop.calibrate.invert.invert import (
        NO_MODEL_ERROR,
        NOT_INFORMATIVE,
        Settings,
        invert_recording,
        off_command,
    )
    from brushloop.model.inversion.press import Range
    from brushloop.sessions.progress import shown

    try:
        within = Range(depth_range, tilt_range)
        if tilt_range[1] > 30:
            raise ValueError(f"tilt_deg = {tilt_range}: expected 0 to 30")
    except ValueError as error:
        raise CalibrationError("--depth-range, --tilt-range", str(error)) from None
    fitted, cells = None, frozenset[tuple[float, float]]()
    if fit is not None:
        from brushloop.calibrate.artefact import load_artefact
        from brushloop.calibrate.fit.artefact import BrushFit
        from brushloop.model.fitted import NAMES
        from brushloop.model.fitted_shape import fitted_model

        artefact = load_artefact(fit, BrushFit)
        press, cells = artefact.press(), frozenset(artefact.cells)
        fitted = fitted_model(press)
        model = fitted.name
        # A fitted brush marks nothing above its zero offset.
        least = max(within.depth_mm[0], 0.5 - float(press.values[NAMES.index("h0_mm")]))
        if least >= within.depth_mm[1]:
            raise CalibrationError("--depth-range", f"ends before the fitted brush marks, at {least:.2f} mm")
        within = Range((least, within.depth_mm[1]), within.tilt_deg)
    settings = Settings(model, fitted, cells, lam, within, anchor_sd, Field(mm_per_px=mm_per_px))
    with shown() as progress:
        made = invert_recording(session, settings, calibration, presses, progress)
    protocol = write_inversion(made, out, repeats, seed)
    say(f"{made.header.session_id}: {len(made.rows)} presses recovered by {model} ({made.header.source})")
    for name, mean, sd, inside, n in off_command(made.rows):
        unit = "mm" if name == "H" else "deg"
        scatter = "" if sd is None else f", sd {sd:.3f}"
        say(f"{name}: recovered - commanded {mean:+.3f} {unit}{scatter}; {inside:.0%} of {n} in the interval")
    say(
        "alpha follows from how far the mark lies from the zero-touch point, and is as accurate as the model's "
        "prediction of that distance; the shape of the mark alone does not determine it."
    )
    bare = sum(NO_MODEL_ERROR in row.flags for row in made.rows)
    if bare:
        say(f"warning: {bare} without model error in their intervals: too few cells with a known command")
    for name, flag in NOT_INFORMATIVE.items():
        vague = sum(flag in row.flags for row in made.rows)
        if vague:
            say(f"warning: {vague} not informative on {name}: the interval covers most of the commanded range")
    bound = sum("at_bound" in row.flags for row in made.rows)
    if 2 * bound > len(made.rows):
        say(f"warning: {bound} at a bound: the model does not fit this brush; do not press these again")
    elif bound:
        say(f"warning: {bound} at a bound of the range: their intervals are valid on one side at most")
    for stroke_id, why in made.refused:
        say(f"not used: {stroke_id}: {why}")
    say(str(out), str(protocol))
