"""Find out what a session contained, from its journal and its files together; changes nothing.

The file of every step holds a copy of the journal's `begin` line and, once finished, of its `done` line. Lost lines of
the journal are rebuilt from these word for word, and put back in their place.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from brushloop.sessions.disk import (
    MAX_SNAPSHOT_BYTES,
    SEGMENT_NAME,
    SNAPSHOT_NAMES,
    check_file,
    file_sha256,
    read_bounded,
)
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import (
    Begin,
    CaptureResult,
    Closed,
    Done,
    Doubt,
    Event,
    Lost,
    Open,
    StepKind,
    Void,
    parse_event,
    serial_of,
)
from brushloop.sessions.journal import JOURNAL_NAME, Fault, Line, Reading, read, read_journal
from brushloop.sessions.mcap_file import McapFile, scan
from brushloop.sessions.recording import merged_file, parse_header
from brushloop.sessions.records import BEGIN_NOTE, DONE_NOTE, Header, Topic
from brushloop.sessions.run_state import DoneTwice, RunState
from brushloop.sessions.store import closed

MARKING = (StepKind.PRESS, StepKind.DRAW, StepKind.SELF_CHECK)
"""Kinds of steps that use patches."""


@dataclass(slots=True)
class Evidence:
    """A session's folder as it is, and as it must have been."""

    folder: Path
    final: Path
    """The merged file."""
    has_journal: bool
    reading: Reading
    files: dict[str, McapFile]
    """What the files of steps and the merged file hold, by name."""
    session: str
    """Id of the session: neither lines nor files of another one are evidence of anything."""
    rebuilt: list[Event] = field(default_factory=list[Event])
    """Events missing from the journal and found in the files."""
    lost: int = 0
    """Number of damaged or missing lines of which no file holds a copy."""
    doubtful: list[str] = field(default_factory=list[str])
    """Files of attempts whose sheet and patch are unknown."""
    strays: dict[str, str] = field(default_factory=dict[str, str])
    """Files that cannot stand where they are, and why."""
    state: RunState = field(default_factory=RunState)
    """State after all events."""

    @property
    def intact(self) -> bool:
        """Whether the journal can be kept; lines may still be added."""
        return self.has_journal and not self.reading.faults

    def foreign(self, found: McapFile) -> list[str]:
        """What is wrong with a file of another session: nothing in it is evidence."""
        session = found.session
        return [] if session in ("", self.session) else [f"is of another session, {session[:100]!r}"]

    def events(self) -> Iterator[Event]:
        """Events of the journal as it must have been, with the rebuilt ones in their places.

        `open` comes first, `closed` last, and those of a step before those of the next.
        """
        rebuilt = deque(sorted(self.rebuilt, key=_place))
        while rebuilt and isinstance(rebuilt[0], Open):
            yield rebuilt.popleft()
        for entry in self.reading.entries:
            if isinstance(entry.event, Begin | Done | Closed):
                while rebuilt and _place(rebuilt[0]) < _place(entry.event):
                    yield rebuilt.popleft()
            yield entry.event
        yield from rebuilt


def gather(folder: Path) -> Evidence:
    """Read the journal and the files. Raises `SessionDamaged` if not even a header is left."""
    evidence = _read(folder)
    _rebuild(evidence)
    return evidence


def is_collected(folder: Path) -> bool:
    """Whether a folder holds a journal or files of steps."""
    return (folder / JOURNAL_NAME).exists() or any(_step_files(folder))


def _step_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*.mcap*")) if SEGMENT_NAME.fullmatch(path.name)]


def _place(event: Event) -> float:
    """Where a rebuilt event belongs: the serial number of its step."""
    match event:
        case Open():
            return -1
        case Begin() | Done() | Lost():
            serial = serial_of(event.file)
            return float("inf") if serial is None else serial
        case _:
            return float("inf")


def _read(folder: Path) -> Evidence:
    """Read the journal and the files, and find out whose they are."""
    data, too_large = b"", list[Fault]()
    has_journal = check_file(folder / JOURNAL_NAME)
    try:
        data = read_journal(folder / JOURNAL_NAME) if has_journal else data
    except SessionDamaged as error:
        too_large = [Fault(1, error.what)]
    reading = read(data)
    # A damaged journal may have lost the name of the merged file.
    final = merged_file(folder, reading.state if has_journal and not reading.faults else None)
    files = {path.name: scan(path) for path in [*_step_files(folder), *([final] if final.is_file() else [])]}
    named = "" if reading.state.opened is None else reading.state.opened.header.session_id
    session = _session(folder.name, named, Counter(found.session for found in files.values() if found.session))
    if session not in ("", named):
        reading = read(data, session)
    reading.faults[:0] = too_large
    return Evidence(folder, final, has_journal, reading, files, session)


def _session(folder: str, named: str, files: Counter[str]) -> str:
    """Id of the session in a folder: its name, unless neither journal nor files say it; then the id of most files."""
    if folder == named or folder in files:
        return folder
    return named if not files or files[named] == max(files.values()) else files.most_common(1)[0][0]


def _rebuild(evidence: Evidence) -> None:
    """Rebuild what the journal lost from the notes in the files, and the state after it."""
    reading = evidence.reading
    for done in reading.twice:
        first = reading.state.done.get(done.key, done)
        if first.file != done.file and not (evidence.folder / first.file).exists():
            why = "its file is gone, and the step was done again"
            evidence.rebuilt += [Lost(t_ns=done.t_ns, key=done.key, file=first.file, why=why), done]
    _rebuild_steps(evidence)
    if reading.state.opened is None:
        evidence.rebuilt.append(Open(t_ns=0, header=_header(evidence), snapshots=_snapshots(evidence.folder)))
    for event in list(evidence.events()):
        try:
            evidence.state.apply(event)
        except DoneTwice:
            # Only a rebuilt event can raise this: the journal's own were applied before.
            evidence.rebuilt = [other for other in evidence.rebuilt if other is not event]
    _rebuild_closed(evidence)
    evidence.lost = _lost(evidence)


def _rebuild_steps(evidence: Evidence) -> None:
    """Rebuild `begin` and `done` from the notes in the files of steps, whatever these are called now."""
    events = [entry.event for entry in evidence.reading.entries]
    begun = {event.file: event for event in events if isinstance(event, Begin)}
    finished = {event.file for event in [*events, *evidence.rebuilt] if isinstance(event, Done)}
    doubted = {event.file for event in events if isinstance(event, Doubt)}
    over: set[str | tuple[str, int]] = {event.file for event in events if isinstance(event, Lost)}
    over |= {(event.key, event.attempt) for event in events if isinstance(event, Void)}
    attempts = dict(evidence.reading.state.attempts)
    unlisted: list[str] = []
    for name, found in evidence.files.items():
        step_name = SEGMENT_NAME.fullmatch(name)
        if step_name is None:
            continue
        own = name.removesuffix(".part")
        if foreign := evidence.foreign(found):
            evidence.strays |= {} if own in begun else {name: foreign[0]}
            continue
        begin = _begin(found) or begun.get(own)
        if begin is None:
            if step_name[2] in MARKING and name not in doubted:
                evidence.doubtful.append(name)
            continue
        if begin.file not in begun:
            begun[begin.file] = begin
            attempts[begin.key] = max(attempts.get(begin.key, 0), begin.attempt)
            evidence.rebuilt.append(begin)
        if own != begin.file:
            unlisted.append(name)
        over_already = begin.file in over or (begin.key, begin.attempt) in over
        if name != own or begin.file in finished or over_already or attempts[begin.key] > begin.attempt:
            continue
        known = evidence.reading.state.done.get(begin.key)
        if known is not None and Topic.STROKE in known.counts:
            continue
        done = _done(found, begin)
        if done is not None:
            # An empty digest matches no file, so a damaged file is found and repaired like any other.
            whole = own == begin.file and not found.damage and dict(found.counts) == done.counts
            finished.add(done.file)
            evidence.rebuilt.append(done.model_copy(update={"sha256": file_sha256(found.path) if whole else ""}))
        elif own == begin.file:
            evidence.strays[name] = "is finished, but the result of its step cannot be read"
    words = "holds a step that the journal lists under another file"
    evidence.strays |= {name: words for name in unlisted if name.removesuffix(".part") not in begun}


def _begin(found: McapFile) -> Begin | None:
    """The `begin` that a file notes; None where it makes no sense."""
    event = _noted(found.notes.get(BEGIN_NOTE, {}))
    return event if isinstance(event, Begin) else None


def _done(found: McapFile, begin: Begin) -> Done | None:
    """The `done` that a file notes, without a digest; that of a capture is also known from its stroke."""
    line: Line = {"event": "done", **found.notes.get(DONE_NOTE, {}), "file": begin.file, "sha256": ""}
    if DONE_NOTE not in found.notes and begin.press is not None and found.counts[Topic.STROKE]:
        stills = [message.sequence for _schema, _channel, message in found.messages((Topic.STROKE,))]
        result = CaptureResult(press=begin.press, still=stills[-1]).model_dump(exclude_none=True)
        line |= {"t_ns": begin.t_ns, "key": begin.key, "attempt": begin.attempt, "counts": found.counts}
        line |= {"result": result}
    event = _noted(line)
    return event if isinstance(event, Done) else None


def _noted(line: Line) -> Event | None:
    try:
        return parse_event(line)
    except ValueError:
        return None


def _header(evidence: Evidence) -> Header:
    """Header of the session in one of its files, preferably where it matches its CRC. Raises `SessionDamaged`."""
    ours = [found for found in evidence.files.values() if found.header is not None and not evidence.foreign(found)]
    if not ours:
        raise SessionDamaged(evidence.folder / JOURNAL_NAME, "has no `open` event, and no file holds its header")
    return parse_header(max(ours, key=lambda found: found.session == evidence.session))


def _snapshots(folder: Path) -> dict[str, str]:
    present = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
    return {path.name: read_bounded(path, MAX_SNAPSHOT_BYTES).decode("utf-8", "replace") for path in present}


def _rebuild_closed(evidence: Evidence) -> None:
    """Rebuild `closed` if the merged file is sound and holds all messages that the journal counts, or more.

    It holds more where the files of steps are lost with their lines: it is then the only copy.
    """
    found, state = evidence.files.get(evidence.final.name), evidence.state
    if state.closed is not None or found is None or found.damage or found.session != evidence.session:
        return
    if found.counts and found.counts >= Counter(state.counts()):
        event = closed(evidence.final, dict(found.counts), state.last_ns)
        evidence.rebuilt.append(event)
        state.apply(event)


def _lost(evidence: Evidence) -> int:
    """Number of missing or damaged lines, less those that were rebuilt in the same place."""
    entries = evidence.reading.entries
    numbers = {id(entry.event): entry.seq for entry in entries}
    lost = rebuilt = last = 0
    for event in evidence.events():
        seq = numbers.get(id(event))
        if seq is None:
            rebuilt += 1
        else:
            lost, rebuilt, last = lost + max(0, seq - last - 1 - rebuilt), 0, seq
    end = max((entry.number for entry in entries), default=0)
    return lost + max(0, sum(number > end for number in evidence.reading.damaged) - rebuilt)
