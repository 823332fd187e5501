"""`brushloop calibrate`. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say


def calibrate(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file.")],
    lens: Annotated[
        Path | None, typer.Option(help="Lens file of `camera intrinsics`; the session's own by default.")
    ] = None,
) -> None:
    """Fit scale and paper plane from the board in view; writes an immutable calibration/<hash>.json."""

    from calibrate.artefact import Calibration, load_artefact
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
