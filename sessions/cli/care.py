"""`brushloop sessions show|verify|repair|close`: look after a session. Heavy imports wait until a command runs.

Exit codes beside the usual ones: 3 repaired, but something is lost; 6 damaged.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sessions.terminal import say

LOSSY, DAMAGED = 3, 6
SESSION = typer.Argument(help="A session's folder, or its .mcap file.")


def show(
    session: Annotated[Path, SESSION],
    as_json: Annotated[bool, typer.Option("--json", help="Everything, as one JSON object.")] = False,
    files: Annotated[bool, typer.Option("--files", help="List every step's file too.")] = False,
) -> None:
    """Show what is in a session: steps, strokes per cell of the grid, sheets, files, devices."""
    import json
    from dataclasses import asdict

    from sessions.show import details

    told = details(session)
    if as_json:
        say(json.dumps(asdict(told), ensure_ascii=False))
        return

    from sessions.show_text import renderables

    say(*renderables(told, files=files))


def verify(session: Annotated[Path, SESSION]) -> None:
    """Read every file again, check each against its CRC, its counts and the journal, and decode every image.

    Exit code 0: all is sound. 6: something is damaged, and is named.
    """
    from sessions.verify import verify_session

    verdict = verify_session(session)
    for finding in verdict.findings:
        say(f"damaged: {finding.file}: {finding.what}")
    for note in verdict.notes:
        say(f"note: {note}")
    read = f"{verdict.files} files, {verdict.strokes} strokes, {verdict.messages} messages"
    if verdict.sound:
        say(f"{verdict.session} ({verdict.state}) is sound: {read}")
        return
    say(f"{verdict.session} ({verdict.state}) is damaged. Try `brushloop sessions repair {session}`")
    raise typer.Exit(DAMAGED)


def repair(session: Annotated[Path, SESSION]) -> None:
    """Give back every intact finished stroke of a damaged session, mark the rest as lost, and say what was done.

    Nothing recorded is overwritten: damaged files are kept as `<name>.damaged-1`. Exit code 0: nothing was lost.
    3: something was, and is named. 6: nothing could be rebuilt.
    """
    import time

    from sessions.repair.repair import repair_session

    report = repair_session(session, time.time_ns)
    for line in report.did:
        say(line)
    for line in report.lost:
        say(f"lost: {line}")
    if report.lossless:
        what = "nothing was lost" if report.did else "was sound; nothing was changed"
        say(f"{report.session}: {what}, {report.strokes} strokes")
        return
    say(f"{report.session}: {report.strokes} strokes were given back whole, the rest is named above")
    raise typer.Exit(LOSSY)


def close(session: Annotated[Path, typer.Argument(help="The folder of a session that was left open.")]) -> None:
    """Write the merged MCAP of a session that was left open, and read it back: it cannot be collected into after."""
    import time

    from sessions.store import SessionStore

    store = SessionStore(session.resolve(), None, time.time_ns)
    try:
        final = store.close()
    finally:
        store.release()
    say(f"Closed: {final}")
