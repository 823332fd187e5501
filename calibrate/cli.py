"""`brushloop calibrate` and `brushloop validate`. Heavy imports wait until a command runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def calibrate(
    session: Annotated[Path, typer.Argument(help="A session's folder or its .mcap file.")],
) -> None:
    """Fit scale and paper plane from the board in view; writes an immutable calibration/<hash>.json."""
    import rich
    from rich.markup import escape

    from calibrate.artefact import load
    from calibrate.calibration import calibrate_session

    path = calibrate_session(session)
    made = load(path)
    rich.print(
        f"pix2len {made.mm_per_px:.5f} mm/px (95 %: {made.mm_per_px_low:.5f} to {made.mm_per_px_high:.5f}), "
        f"board residual {made.rms_px:.3f} px over {made.corners} corners, {made.source}\n{escape(str(path))}"
    )


def validate(
    session: Annotated[list[Path], typer.Argument(help="Sessions: folders or .mcap files.")],
    model: Annotated[list[str] | None, typer.Option(help="Only these models; all by default.")] = None,
    mm_per_px: Annotated[float, typer.Option(min=0.1, max=1.0, help="Scale of the 128 x 128 mm field.")] = 0.3,
    calibration: Annotated[Path | None, typer.Option(help="Artefact; the session's newest by default.")] = None,
    fit: Annotated[Path | None, typer.Option(help="Brush fit; the session's newest by default.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for reports; <session>/validation by default.")] = None,
) -> None:
    """Compare every model with every captured stroke; writes a self-contained HTML report and a CSV."""
    import sys

    import rich
    from rich.markup import escape

    from calibrate.field import Field
    from calibrate.terminal import summary
    from calibrate.validation import validate_recording
    from calibrate.write import write_report
    from sessions.reader import Recording

    command = " ".join(["brushloop", *sys.argv[1:]])
    for one in session:
        Recording(one)  # all of them can be read, before anything is written for the first
    for one in session:
        validation = validate_recording(one, model or [], Field(mm_per_px=mm_per_px), calibration, fit)
        folder = out / validation.header.session_id if out else validation.recording.parent / "validation"
        report = write_report(validation, folder, command)
        rich.print(*summary(validation), sep="\n")
        rich.print(f"Report: {escape(str(report))}")
