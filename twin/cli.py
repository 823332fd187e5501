"""`brushloop twin`: a simulated brush that presses like a captured one. Heavy imports wait until the command runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.sessions.terminal import say

if TYPE_CHECKING:
    from collections.abc import Iterator

    from brushloop.calibrate.fit.captures import Captures
    from brushloop.twin.run import Twin


def twin(
    session: Annotated[Path, typer.Argument(help="A session of presses: its folder or its .mcap file.")],
    out: Annotated[Path | None, typer.Option(help="File to write; twin.toml in the session's folder.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="Artefact; the one in use by default.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:
    """Fit the simulator's brush, ink and camera noise to a session's presses; writes twin.toml.

    `brushloop sim --brush twin.toml` is then a rig that presses like that brush. A run that was interrupted
    continues when the same command is given again.
    """
    from shlex import quote

    from brushloop.calibrate.artefact import made_by
    from brushloop.calibrate.compare.place import Field
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_target, write_whole
    from brushloop.calibrate.fit.captures import read_presses
    from brushloop.sessions.recording import Recording
    from brushloop.sessions.terminal import shown
    from brushloop.twin.file import Notes, noise_gray, twin_toml
    from brushloop.twin.run import fit_twin, workers

    recording = Recording(session)
    target = out or recording.path.parent / "twin.toml"
    check_target(target, ".toml")
    if target.exists() and not replace:
        raise CalibrationError(str(target), "exists: give --out FILE or --replace")
    with shown() as progress:
        captures = read_presses(session, Field(), calibration, progress)
        opened = captures.session
        notes = Notes(target, opened.sha256, opened.calibration_digest, f"{MM_PER_PX:g} mm/px", made_by())
        brush = captures.radius_mm, captures.length_mm
        with workers() as pool:
            try:
                fitted = fit_twin(captures.strokes, captures.grid, *brush, pool, progress, notes.known)
            except ValueError as error:
                raise CalibrationError(str(recording.path), str(error)) from None
    noise = noise_gray(recording)
    write_whole(target, twin_toml(fitted, captures.session.header.session_id, noise))
    notes.path.unlink(missing_ok=True)
    say(*_tables(captures, fitted, noise), f"Twin: {target}", f"next: brushloop sim --brush {quote(str(target))}")


def _tables(captures: Captures, fitted: Twin, noise: float | None) -> Iterator[object]:
    from rich.table import Table

    from brushloop.calibrate.report import source_note

    header = captures.session.header
    yield f"{source_note(header.source, header.brush)}; twin of {len(captures.strokes)} presses"
    for name, why in captures.refused:
        yield f"left out: {name}: {why}"
    out = Table("constant", "unit", "default", "twin", "95 %", title="simulated brush")
    for one in fitted.estimates:
        found = (f"{one.value:.4g}", f"{one.low:.3g} to {one.high:.3g}") if one.determined else ("", "not determined")
        out.add_row(one.constant.name, one.constant.unit, f"{one.constant.default:.4g}", *found)
    yield out
    if noise is None:
        yield "The camera's noise was not measured: no two stills show the same view."
    else:
        yield f"camera noise: {noise:.2f} gray levels"
    if fitted.held_out:
        out = Table("model", "n", "CSIM", "SSIM", title="a third of the cells left out in turn, mm, binary, percent")
        for row in fitted.held_out:
            out.add_row(row.model, str(row.n), f"{row.csim:.2f}", f"{row.ssim:.2f}")
        yield out
    if fitted.spread is None:
        yield "No cell has three captures: how presses differ is left as in the default brush."
    else:
        yield (
            f"Two presses of a cell agree to CSIM {fitted.spread.captured_percent:.2f} % as captured, and to "
            f"{fitted.spread.twin_percent:.2f} % from the twin."
        )
