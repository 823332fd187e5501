"""`brushloop sessions ...`: inspect, check and repair recordings.

`import` and `export` need what is in `calibrate`: the front door adds them from `calibrate/commands.py`.

Heavy imports wait until a command runs. Additional exit codes: 3 repaired, but something is lost; 6 damaged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brushloop.sessions.terminal import say, shown

LOSSY, DAMAGED = 3, 6
Session = Annotated[Path, typer.Argument(help="A session's folder, or its .mcap file.")]

app = typer.Typer(help="Inspect, check, repair, import and export recordings.", no_args_is_help=True)


@app.command("list")
def list_(
    root: Annotated[Path, typer.Argument(help="Folder that holds sessions.")] = Path("sessions"),
) -> None:
    """List the sessions under a folder: closed, imported, or still open."""
    from rich.table import Table

    from brushloop.sessions.show import summaries

    rows = list(summaries(root))
    if not rows:
        say(f"There are no sessions in {root}")
        return
    table = Table("session", "state", "source", "strokes", "file")
    for row in rows:
        table.add_row(row.session_id, row.state, row.source, str(row.strokes), row.file)
    say(table)


@app.command()
def show(
    session: Session,
    as_json: Annotated[bool, typer.Option("--json", help="Print all details as one JSON object.")] = False,
) -> None:
    """Show what is in a session: steps, strokes per condition, sheets, devices."""
    from pydantic import TypeAdapter

    from brushloop.sessions.show import Details, details, renderables

    found = details(session)
    say(*([TypeAdapter(Details).dump_json(found).decode()] if as_json else renderables(found)))


@app.command()
def verify(session: Session) -> None:
    """Read every file again, check each against its CRC, its counts and the journal, and decode every image.

    Exit code 0: everything is intact. Exit code 6: something is damaged, and is named.
    """
    from brushloop.sessions.verify import verify_session

    with shown() as progress:
        verdict = verify_session(session, progress)
    for file, problems in verdict.findings.items():
        say(*(f"damaged: {file}: {problem}" for problem in problems))
    say(*(f"note: {note}" for note in verdict.notes))
    read = f"{verdict.files} files, {verdict.strokes} strokes, {verdict.messages} messages"
    if verdict.sound:
        say(f"{verdict.session} ({verdict.state}) is sound: {read}")
        return
    say(f"{verdict.session} ({verdict.state}) is damaged. Try `brushloop sessions repair {session}`")
    raise typer.Exit(DAMAGED)


@app.command()
def repair(session: Session) -> None:
    """Recover every intact finished stroke of a damaged session, mark the rest as lost, and report what was done.

    Nothing recorded is overwritten: damaged files are kept as `<name>.damaged-1`. Exit code 0: nothing was lost.
    Exit code 3: something was lost, and is named. Exit code 6: nothing could be rebuilt.
    """
    import time

    from brushloop.sessions.repair import repair_session

    report = repair_session(session, time.time_ns)
    say(*report.did, *(f"lost: {line}" for line in report.lost))
    if not report.lost:
        what = "nothing was lost" if report.did else "was sound; nothing was changed"
        say(f"{report.session}: {what}, {report.strokes} strokes")
        return
    say(f"{report.session}: {report.strokes} strokes were recovered completely, the rest is named above")
    raise typer.Exit(LOSSY)


@app.command()
def close(session: Annotated[Path, typer.Argument(help="The folder of a session that was left open.")]) -> None:
    """Write the merged MCAP of a session that was left open, and read it back. The session then ends."""
    import time

    from brushloop.sessions.store import SessionStore

    store = SessionStore(session.resolve(), time.time_ns)
    try:
        final = store.close()
    finally:
        store.release()
    say(f"Closed: {final}")
