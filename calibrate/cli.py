"""`brushloop calibrate SESSION`, and its further commands: show, diff, apply, preprocess."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from calibrate.path_or_command import PathOrCommand
from sessions.terminal import say


def calibrate(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file.")],
    lens: Annotated[
        Path | None, typer.Option(help="Lens file of `camera intrinsics`; the session's own by default.")
    ] = None,
) -> None:
    """Fit scale and paper plane from the board in view; writes an immutable calibration/<hash>.json."""

    from calibrate.artefact import load_artefact
    from calibrate.calibration import Calibration
    from calibrate.session import calibrate_session

    path = calibrate_session(session, lens)
    made = load_artefact(path, Calibration)
    for flag in made.flags:
        say(f"warning: {flag}")
    say(
        f"pix2len {made.mm_per_px:.5f} mm/px (95 %: {made.mm_per_px_low:.5f} to {made.mm_per_px_high:.5f}), "
        f"board residual {made.rms_px:.3f} px over {made.corners} corners, {made.source}",
        f"lens: {made.lens.source if made.lens else 'none'}",
        str(path),
    )


app = typer.Typer(
    cls=PathOrCommand,
    help="Fit scale and paper plane of a SESSION (`brushloop calibrate SESSION`), or look at what comes before.",
)
app.command("session")(calibrate)


@app.command()
def show(
    artefact: Annotated[Path, typer.Argument(help="A calibration, lens, registration or brush fit, or a session.")],
) -> None:
    """Show the contents of an artefact, or of the calibration that a session uses."""
    from calibrate.describe import described, read_any

    path, made = read_any(artefact)
    say(str(path), *described(made))


@app.command()
def diff(
    one: Annotated[Path, typer.Argument(help="An artefact, or a session: the calibration that it uses.")],
    other: Annotated[Path, typer.Argument(help="Another of the same kind.")],
) -> None:
    """Show how two artefacts differ, and for calibrations what that means on the paper."""
    from calibrate.describe import differences, read_any

    lines = differences(read_any(one)[1], read_any(other)[1])
    say(*(lines or ["they are equal"]))


@app.command("apply")
def apply_to(
    calibration: Annotated[Path, typer.Argument(help="A calibration/<hash>.json.")],
    session: Annotated[Path, typer.Argument(help="The session that it is to be used for.")],
    force: Annotated[bool, typer.Option(help="Also another session's; every result is then labelled.")] = False,
) -> None:
    """Use a calibration for a session from now on; another session's needs --force."""
    from calibrate.artefact import load_artefact
    from calibrate.calibration import Calibration
    from calibrate.session import apply_calibration

    path = apply_calibration(calibration, session, force=force)
    if label := load_artefact(path, Calibration).label:
        say(f"warning: {label}")
    say(str(path))


@app.command()
def preprocess(
    capture: Annotated[Path, typer.Argument(help="A session (folder or .mcap), or a photograph.")],
    stroke: Annotated[str, typer.Option(help="Stroke of the session, the first by default.")] = "",
    px_per_mm: Annotated[float | None, typer.Option(help="Scale of a photograph.")] = None,
    before: Annotated[Path | None, typer.Option(help="Photograph of the page before the stroke came.")] = None,
    lens: Annotated[Path | None, typer.Option(help="Lens file; the session's own by default.")] = None,
    out: Annotated[Path, typer.Option(help="The picture; the numbers go beside it as .json.")] = Path("stages.png"),
) -> None:
    """Show every stage of one capture in one picture, and write each fitted number to a JSON file."""
    from calibrate.files import check_target
    from calibrate.show_stages import show_photograph, show_stroke

    check_target(out, ".png", capture, before)
    if capture.suffix.lower() in (".png", ".jpg", ".jpeg"):
        trace = show_photograph(capture, px_per_mm, before, out)
    else:
        trace = show_stroke(capture, stroke, out, lens=lens)
    for name, value in trace.log.items():
        say(f"{name} {value:.6g}")
    for flag in trace.flags:
        say(f"flag: {flag}")
    say(str(out))
