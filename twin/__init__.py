"""A twin of a brush: the simulator's brush, ink and camera noise, fitted to captured presses (`brushloop twin`).

Here is the command; heavy imports wait until it runs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.sessions.terminal import say


def twin(
    session: Annotated[Path, typer.Argument(help="A session of presses: its folder or its .mcap file.")],
    out: Annotated[Path | None, typer.Option(help="File to write; twin.toml in the session's folder.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the file if it exists.")] = False,
) -> None:
    """Fit the simulator's brush, ink and camera noise to a session's presses; writes twin.toml.

    `brushloop sim --brush twin.toml` is then a rig that presses like that brush. A run that was interrupted
    continues when the same command is given again.
    """
    from shlex import quote

    from brushloop.calibrate.compare.place import Field
    from brushloop.calibrate.errors import CalibrationError
    from brushloop.calibrate.files import check_target, write_whole
    from brushloop.calibrate.fit.captures import near_ink, read_presses
    from brushloop.calibrate.report import source_note
    from brushloop.sessions.recording import Recording
    from brushloop.sessions.terminal import shown
    from brushloop.twin.run import fit_twin, noise_gray, twin_toml, workers

    recording = Recording(session)
    target = out or recording.path.parent / "twin.toml"
    check_target(target, ".toml")
    if target.exists() and not replace:
        raise CalibrationError(str(target), "exists: give --out FILE or --replace")
    with shown() as progress:
        captures = read_presses(session, Field(), progress)
        header, store = captures.session.header, captures.session.store
        brush = captures.radius_mm, captures.length_mm
        strokes, grid = near_ink(captures.strokes, captures.grid)
        with workers() as pool:
            try:
                fitted = fit_twin(strokes, grid, *brush, pool, progress, store)
            except ValueError as error:
                raise CalibrationError(str(recording.path), str(error)) from None
    text = twin_toml(fitted, header.session_id, noise_gray(recording))
    write_whole(target, text)
    say(f"{source_note(header.source, header.brush)}; twin of {len(captures.strokes)} presses")
    say(*(f"left out: {name}: {why}" for name, why in captures.refused), *text.splitlines())
    say(f"Twin: {target}", f"next: brushloop sim --brush {quote(str(target))}")
