"""Judge a session: what it contained according to its journal and its files together, and every difference from that.

The file of every step holds a copy of the journal's `begin` line and, once finished, of its `done` line, and so does
the merged file: lines that the journal lost are rebuilt from these word for word. Every file is read again in full.
`brushloop sessions verify` prints the verdict, and `repair` acts on it; judging changes nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from brushloop.sessions import events
from brushloop.sessions.disk import (
    MAX_SNAPSHOT_BYTES,
    SEGMENT_NAME,
    SNAPSHOT_NAMES,
    check_digest,
    check_file,
    file_sha256,
    holds,
    read_bounded,
)
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError
from brushloop.sessions.events import Begin, Done, Event, StepEvent, StepKind, serial_of, step_words
from brushloop.sessions.journal import JOURNAL_NAME, DoneTwice, Reading, RunState, read, read_journal
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import Recording, check_path, find_recording, parse_header, remarks_of
from brushloop.sessions.records import HEADER_FILE, Stroke, Topic
from brushloop.sessions.store import closed
from brushloop.sessions.terminal import Progress, counted, unseen

MARKING = (StepKind.PRESS, StepKind.SELF_CHECK)
"""Kinds of steps that use patches."""
UNKNOWN_PATCH = "does not say which patch of which sheet it pressed"


@dataclass(slots=True)
class Evidence:
    """A session's folder as it is, and as it must have been."""

    folder: Path
    final: Path
    """The merged file."""
    reading: Reading
    files: dict[str, McapFile]
    """What the files of steps and the merged file hold, by name, but those of another session."""
    session: str
    """Id of the session: neither lines nor files of another one are evidence of anything."""
    rebuilt: list[Event] = field(default_factory=list[Event])
    """Events missing from the journal and found in the files."""
    strays: dict[str, str] = field(default_factory=dict[str, str])
    """Files that cannot stand where they are, and why."""
    state: RunState = field(default_factory=RunState)
    """State after all events."""

    @property
    def lost(self) -> int:
        """Number of damaged or missing lines, as far as their numbers show it, for which nothing was rebuilt."""
        last = max((_place(event) for event in self.reading.events), default=0.0)
        behind = sum(_place(event) > last for event in self.rebuilt)
        return max(0, self.reading.missing + behind - len(self.rebuilt)) + max(0, self.reading.unread - behind)

    def events(self) -> list[Event]:
        """Events of the journal as it must have been, with the rebuilt ones in their places."""
        placed = [(_place(event), event) for event in self.rebuilt]
        place = -1.0
        for event in self.reading.events:
            place = max(place, _place(event))
            placed.append((place, event))
        return [event for _, event in sorted(placed, key=lambda one: one[0])]


def _place(event: Event) -> float:
    """Where an event belongs: by the serial number of its step; -1 for one that stays behind the one before it."""
    match event:
        case events.Open():
            return -2
        case Begin() | Done():
            return serial_of(event.file) + isinstance(event, Done) / 2
        case events.Closed():
            return float("inf")
        case _:
            return -1


def gather(folder: Path) -> Evidence:
    """Read the journal and the files, and rebuild what the journal lost.

    Raises `SessionDamaged` if not even a header is left.
    """
    data, unreadable = b"", list[str]()
    try:
        if check_file(folder / JOURNAL_NAME):
            data = read_journal(folder / JOURNAL_NAME)
        else:
            unreadable = ["is missing, though the folder holds recordings"]
    except SessionDamaged as error:
        unreadable = [error.what]
    reading = read(data)
    recordings = [path for path in sorted(folder.glob("*.mcap")) if not SEGMENT_NAME.fullmatch(path.name)]
    files = {path.name: McapFile(path, check=True) for path in (*_step_files(folder), *recordings)}
    named = "" if reading.state.opened is None else reading.state.opened.header.session_id
    session = _session(folder.name, named, Counter(file.session for file in files.values() if file.session))
    if session not in ("", named):
        reading = read(data, session)
    reading.faults[:0] = unreadable
    final = folder / f"{session}.mcap"
    files = {name: file for name, file in files.items() if SEGMENT_NAME.fullmatch(name) or name == final.name}
    foreign = {name: files.pop(name).session for name in list(files) if files[name].session not in ("", session)}
    evidence = Evidence(folder, final, reading, files, session)
    _rebuild_steps(evidence)
    if reading.state.opened is None:
        evidence.rebuilt.append(_opened(evidence))
    for event in evidence.events():
        try:
            evidence.state.apply(event)
        except DoneTwice:
            # Only a rebuilt event can raise this: the journal's own were applied before.
            evidence.rebuilt = [other for other in evidence.rebuilt if other is not event]
    _find_strays(evidence)
    merged, state = files.get(final.name), evidence.state
    if state.closed is None and merged is not None and not merged.damage and merged.counts == Counter(state.counts()):
        last_ns = max(event.t_ns for event in evidence.events())
        evidence.rebuilt.append(closed(final, dict(merged.counts), last_ns))
        state.apply(evidence.rebuilt[-1])
    for name, other in foreign.items():
        # What the journal lists is told as changed, and written again from its other copy.
        if name not in state.files and (state.closed is None or name != final.name):
            evidence.strays[name] = f"is of another session, {other[:100]!r}"
    return evidence


def is_collected(folder: Path) -> bool:
    """Whether a folder holds a journal or files of steps."""
    return (folder / JOURNAL_NAME).exists() or bool(_step_files(folder))


def _step_files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*.mcap*")) if SEGMENT_NAME.fullmatch(path.name)]


def _session(folder: str, named: str, files: Counter[str]) -> str:
    """Id of the session in a folder: its name, unless neither journal nor files say it; then the id of most files."""
    if folder == named or folder in files:
        return folder
    return named if not files or files[named] == max(files.values()) else files.most_common(1)[0][0]


def _rebuild_steps(evidence: Evidence) -> None:
    """Rebuild `begin` and `done` from the files, whatever these are called now."""
    known = evidence.reading.events
    steps = [(name, step) for name, file in evidence.files.items() for step in steps_in(file)]
    begun = {event.file: event for event in known if isinstance(event, Begin)}
    begins = [step for _name, step in steps if isinstance(step, Begin)]
    ends = [event for event in [*known, *(step for _name, step in steps)] if isinstance(event, Done)]
    for begin in [*begins, *(end.begin() for end in ends)]:
        if begun.setdefault(begin.file, begin) is begin:
            evidence.rebuilt.append(begin)
    latest: dict[str, int] = {}
    for begin in begun.values():
        # A set-up step is done again for another sheet: an attempt that only a file proves does not end an earlier one.
        if begin.kind in (StepKind.PRESS, StepKind.CAPTURE) or begin in known:
            latest[begin.key] = max(latest.get(begin.key, 0), begin.attempt)
    over = _over(known)
    for name, step in steps:
        if isinstance(step, Begin) or name.endswith(".part"):
            continue
        if step.attempt >= latest.get(step.key, 0) and over.isdisjoint((step.file, (step.key, step.attempt))):
            over.add(step.file)
            # An empty digest matches no file, so a damaged file is found and repaired like any other.
            file = evidence.files[name]
            whole = name == step.file and not file.damage and dict(file.counts) == step.counts
            evidence.rebuilt.append(step.model_copy(update={"sha256": file_sha256(file.path) if whole else ""}))


def _over(known: list[Event]) -> set[str | tuple[str, int]]:
    """Files, and keys and attempts, of steps that are done, void or lost."""
    over: set[str | tuple[str, int]] = {event.file for event in known if isinstance(event, Done | events.Lost)}
    return over | {(event.key, event.attempt) for event in known if isinstance(event, events.Void)}


def _find_strays(evidence: Evidence) -> None:
    """Tell the files of steps that belong to none, and those that may hide a press on an unknown patch."""
    known = evidence.events()
    begun = {event.file: event for event in known if isinstance(event, Begin)}
    over = _over(known)
    for name, file in evidence.files.items():
        begin, step_name = begun.get(name.removesuffix(".part")), SEGMENT_NAME.fullmatch(name)
        if step_name is None or (begin is not None and name.endswith(".part")):
            continue
        if begin is None and step_name[2] in MARKING and begun.keys().isdisjoint(step.file for step in steps_in(file)):
            evidence.strays[name] = UNKNOWN_PATCH
        elif begin is None:
            evidence.strays[name] = "belongs to no step of the session"
        elif evidence.state.attempts[begin.key] == begin.attempt and over.isdisjoint(
            (name, (begin.key, begin.attempt))
        ):
            evidence.strays[name] = "is finished, but the result of its step cannot be read"


def steps_in(file: McapFile) -> list[Begin | Done]:
    """The begins and ends of steps that can be read in a file, in order."""
    return [step for record in file.messages([Topic.STEP]) if (step := parsed_step(record[2].data)) is not None]


def parsed_step(data: bytes) -> Begin | Done | None:
    """The event in a message on /step; None where it does not fit its schema."""
    try:
        return StepEvent.model_validate_json(data).step
    except ValidationError:
        return None


def _opened(evidence: Evidence) -> events.Open:
    """The `open` of a session, from its files. Raises `SessionDamaged`."""
    ours = [file for file in evidence.files.values() if file.header is not None]
    if not ours:
        raise SessionDamaged(evidence.folder / JOURNAL_NAME, "has no `open` event, and no file holds its header")
    header = parse_header(max(ours, key=lambda file: file.session == evidence.session))  # its CRC matches, if one does
    present = [path for name in SNAPSHOT_NAMES if (path := evidence.folder / name).is_file()]
    texts = {path.name: read_bounded(path, MAX_SNAPSHOT_BYTES).decode("utf-8", "replace") for path in present}
    return events.Open(t_ns=0, header=header, snapshots=texts)


@dataclass(slots=True)
class Verdict:
    """Result of checking a session."""

    session: str
    state: str
    """`closed`, `open`, or `recording` for a file or folder without a journal."""
    findings: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    """What is wrong with each file."""
    notes: list[str] = field(default_factory=list[str])
    """Observations that are not damage."""
    files: int = 0
    """Number of files read in full."""
    strokes: int = 0
    messages: int = 0
    damaged: dict[str, str] = field(default_factory=dict[str, str])
    """Files of finished steps that are missing or have changed, and how."""

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged."""
        return not self.findings

    def find(self, file: str, *problems: str) -> None:
        """Add what is wrong with a file."""
        if problems:
            self.findings[file] = [*self.findings.get(file, []), *problems]


def verify_session(path: Path, progress: Progress = unseen) -> Verdict:
    """Check a session's folder, or one MCAP file.

    Raises `InputError` where it is neither, is of another program, or holds links.
    """
    check_path(path)
    if not is_collected(path):
        return _verify_file(find_recording(path), path.resolve().name, progress)
    try:
        evidence = gather(path.resolve())
    except SessionDamaged as error:
        return Verdict(path.resolve().name, "open", {error.path.name: [error.what]})
    return judge(evidence, progress)


def _verify_file(path: Path, name: str, progress: Progress) -> Verdict:
    file = McapFile(path, check=True)
    verdict = Verdict(name, "recording", files=1, strokes=file.counts[Topic.STROKE], messages=file.counts.total())
    if file.index is not None and HEADER_FILE not in (one.name for one in file.index.attachment_indexes):
        raise InputError(path, f"is an MCAP file, but not a brushloop session: its index lists no {HEADER_FILE}")
    verdict.find(path.name, *file.damage, *_content_problems(file, progress))
    if verdict.sound:
        try:
            Recording(path)
        except SessionError as error:
            verdict.find(path.name, error.what)
    return verdict


def judge(evidence: Evidence, progress: Progress = unseen) -> Verdict:
    """Judge a session's folder by its files and by what its journal must have said."""
    folder, state = evidence.folder, evidence.state
    counts = Counter(state.counts() if state.closed is None else state.closed.counts)
    verdict = Verdict(folder.name, "open" if state.closed is None else "closed")
    verdict.strokes, verdict.messages = counts[Topic.STROKE], counts.total()
    _judge_journal(verdict, evidence)
    for done in counted(list(state.files.values()), "files of steps read", len(state.files), progress):
        _judge_file(verdict, evidence, done.file, done)
    for name, text in ({} if state.opened is None else state.opened.snapshots).items():
        if not holds(folder / name, text.encode()):
            verdict.find(name, "is missing, or has changed since the session was started")
    _judge_file(verdict, evidence, evidence.final.name, state.closed, progress)
    if verdict.sound:  # then every reader can read it
        try:
            remarks_of(folder)
            if state.closed is not None:
                Recording(folder)
        except (InputError, SessionDamaged) as error:
            verdict.find(error.path.name, error.what)
    for repair in state.repairs:
        if isinstance(repair, events.Lost):
            verdict.notes.append(f"{repair.file} was lost: {repair.why}")
        else:
            missing = count_words(repair.missing) or "nothing"
            verdict.notes.append(f"{repair.file} was repaired; missing: {missing}")
    if kept := [path for path in folder.iterdir() if ".damaged-" in path.name or ".superseded-" in path.name]:
        verdict.notes.append(f"{len(kept)} damaged or replaced files are kept beside the session's own")
    return verdict


def _judge_journal(verdict: Verdict, evidence: Evidence) -> None:
    reading = evidence.reading
    verdict.find(JOURNAL_NAME, *reading.faults)
    if evidence.lost:
        verdict.notes.append(f"{JOURNAL_NAME}: {evidence.lost} of its lines cannot be rebuilt")
    if reading.torn:
        verdict.notes.append(f"{JOURNAL_NAME}: its last line was cut off; the next process or a repair removes it")
    for event in evidence.rebuilt:
        match event:
            case Begin(file=file):
                verdict.find(JOURNAL_NAME, f"does not mention {file}")
            case Done(file=file):
                verdict.notes.append(f"{file}: {step_words(event)} is finished, but the journal does not say so")
            case events.Closed(file=file):
                verdict.notes.append(f"{file} is complete, but the journal has no closing line")
            case _:
                verdict.find(JOURNAL_NAME, "does not say how the session was opened")
    for name, what in evidence.strays.items():
        verdict.find(name, what)


def _judge_file(
    verdict: Verdict, evidence: Evidence, name: str, listed: Done | events.Closed | None, progress: Progress = unseen
) -> None:
    """Judge a file of a step or the merged one by its content and by what the journal says of it, if anything."""
    file, problems = evidence.files.get(name), list[str]()
    verdict.files += file is not None or listed is not None
    if file is not None:
        problems = list(file.damage)
        # In a closed session the merged file holds the same messages, so they are decoded only there.
        if not problems and (evidence.state.closed is None or name == evidence.final.name):
            problems = _content_problems(file, progress)
    if listed is not None:
        try:
            check_digest(evidence.folder / name, listed.sha256)
            if file is not None and not problems and dict(file.counts) != listed.counts:
                problems = [f"holds messages {dict(file.counts)}, but the journal says {listed.counts}"]
        except SessionDamaged as error:
            why = verdict.damaged[name] = "; ".join(problems) or error.what
            lost = Counter[str]() if file is None else Counter(listed.counts) - file.counts
            problems = [why if file is None else f"{why}; messages lost: {count_words(lost) or 'none'}"]
    step = f"({step_words(listed)}) " if isinstance(listed, Done) else ""
    verdict.find(name, *(f"{step}{problem}" for problem in problems))


def _content_problems(file: McapFile, progress: Progress) -> list[str]:
    """Decode the photographs and the strokes of a file, and list what is wrong with them."""
    problems: list[str] = []
    stills: set[int] = set()
    strokes: set[str] = set()
    try:
        for _schema, channel, message in file.messages(topics=(Topic.STILL, Topic.STROKE)):
            if channel.topic == Topic.STILL:
                progress(f"{file.path.name}: photographs decoded", len(stills), file.counts[Topic.STILL])
                where = f"the image {message.sequence} on {channel.topic}"
                decode_gray(decode_still(message.data, where), where)
                stills.add(message.sequence)
                continue
            stroke = Stroke.model_validate_json(message.data)
            if stroke.stroke_id in strokes:
                problems.append(f"stroke {stroke.stroke_id} occurs twice")
            strokes.add(stroke.stroke_id)
            if stroke.still not in stills:
                problems.append(f"stroke {stroke.stroke_id} refers to photograph {stroke.still}, which is missing")
    except SessionDamaged as error:
        problems.append(f"{error.path} {error.what}")
    except ValidationError as error:
        problems.append(f"a message does not fit its schema ({type(error).__name__})")
    return problems


def count_words(counts: Mapping[str, int]) -> str:
    """Text such as `1 of /step, 5 of /robot/tcp`."""
    return ", ".join(f"{count} of {topic}" for topic, count in counts.items())
