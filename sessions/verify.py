"""Judge a session: every file is read again in full, and every difference from what was recorded is described.

`brushloop sessions verify` prints the verdict, and `repair` acts on it; judging changes nothing.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.disk import check_digest, holds
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError
from brushloop.sessions.events import Begin, Closed, Done, Lost, Open, Repaired
from brushloop.sessions.evidence import Evidence, gather, is_collected
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.mcap_file import McapFile, scan
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import Recording, check_path, find_recording
from brushloop.sessions.records import HEADER_NOTE, Stroke, Topic
from brushloop.sessions.show import details, step_words
from brushloop.sessions.terminal import Progress, counted, unseen


@dataclass(frozen=True, slots=True)
class Finding:
    """One difference from what was recorded."""

    file: str
    what: str


@dataclass(slots=True)
class Verdict:
    """Result of checking a session."""

    session: str
    state: str
    """`closed`, `open`, or `recording` for a file or folder without a journal."""
    findings: list[Finding] = field(default_factory=list[Finding])
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
        self.findings += [Finding(file, what) for what in problems]

    def problems(self, file: str) -> list[str]:
        """What is wrong with a file."""
        return [finding.what for finding in self.findings if finding.file == file]


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
        return Verdict(path.resolve().name, "open", [Finding(error.path.name, error.what)])
    return judge(evidence, progress)


def judge(evidence: Evidence, progress: Progress = unseen) -> Verdict:
    """Judge a session's folder by its files and by what its journal must have said."""
    folder, state = evidence.folder, evidence.state
    verdict = Verdict(folder.name, "open" if state.closed is None else "closed")
    _judge_journal(verdict, evidence)
    for done in counted(list(state.files.values()), "files of steps read", len(state.files), progress):
        _judge_step(verdict, evidence, done)
    for name, text in ({} if state.opened is None else state.opened.snapshots).items():
        if not (folder / name).is_file():
            verdict.find(name, "is missing, though the journal holds its text")
        elif not holds(folder / name, text.encode()):
            verdict.find(name, "has changed since the session was started")
    _judge_final(verdict, evidence, progress)
    if verdict.sound:
        _try_readers(verdict, folder)
    _count(verdict, Counter(state.counts() if state.closed is None else state.closed.counts))
    verdict.notes += [f"{repair.file}: {_repair_words(repair)}" for repair in state.repairs]
    kept = [path for path in folder.iterdir() if ".damaged-" in path.name or ".superseded-" in path.name]
    if kept:
        verdict.notes.append(f"{len(kept)} damaged or replaced files are kept beside the session's own")
    return verdict


def content_problems(found: McapFile, progress: Progress = unseen) -> list[str]:
    """Decode the photographs and the strokes of a file, and list what is wrong with them."""
    problems: list[str] = []
    stills: set[int] = set()
    strokes: set[str] = set()
    name = found.path.name
    try:
        for _schema, channel, message in found.messages(topics=(Topic.STILL, Topic.STROKE)):
            if channel.topic == Topic.STILL:
                progress(f"{name}: photographs decoded", len(stills), found.counts[Topic.STILL])
                decode_gray(decode_still(message.data), f"the image {message.sequence} on {channel.topic}")
                stills.add(message.sequence)
                continue
            stroke = Stroke.model_validate_json(message.data)
            if stroke.stroke_id in strokes:
                problems.append(f"stroke {stroke.stroke_id} occurs twice")
            strokes.add(stroke.stroke_id)
            if stroke.still not in stills:
                problems.append(f"stroke {stroke.stroke_id} names still {stroke.still}, which is not there")
    except SessionDamaged as error:
        problems.append(f"{error.path} {error.what}")
    except (DecodeError, ValidationError) as error:
        problems.append(f"a message does not fit its schema ({type(error).__name__})")
    except OSError as error:
        problems.append(f"cannot be read: {error.strerror}")
    return problems


def _verify_file(path: Path, name: str, progress: Progress) -> Verdict:
    verdict = Verdict(name, "recording", files=1)
    found = scan(path)
    if found.index is not None and HEADER_NOTE not in (one.name for one in found.index.metadata_indexes):
        raise InputError(path, f"is an MCAP file, but not a brushloop session: its index lists no {HEADER_NOTE}")
    verdict.find(path.name, *found.damage, *content_problems(found, progress))
    if verdict.sound:
        try:
            Recording(path)
        except SessionError as error:
            verdict.find(path.name, error.what)
    _count(verdict, found.counts)
    return verdict


def _judge_journal(verdict: Verdict, evidence: Evidence) -> None:
    verdict.find(JOURNAL_NAME, *(str(fault) for fault in evidence.reading.faults))
    if evidence.lost:
        verdict.notes.append(f"{JOURNAL_NAME}: {evidence.lost} of its lines cannot be rebuilt")
    elif evidence.reading.faults:
        verdict.notes.append(f"{JOURNAL_NAME}: all of it can be rebuilt from the files")
    if not evidence.has_journal:
        verdict.find(JOURNAL_NAME, "is missing, though the folder holds recordings")
    if evidence.reading.torn:
        verdict.notes.append(f"{JOURNAL_NAME}: its last line was cut off; the next process sets it aside")
    for event in evidence.rebuilt:
        match event:
            case Begin(file=file):
                verdict.find(JOURNAL_NAME, f"does not mention {file}")
            case Done(file=file):
                verdict.notes.append(f"{file}: {step_words(event)} is finished, but not journalled as done")
            case Closed(file=file):
                verdict.notes.append(f"{file} is complete, but not journalled as closed")
            case Open():
                verdict.find(JOURNAL_NAME, "does not say how the session was opened")
            case _:
                pass
    for name, what in evidence.strays.items():
        verdict.find(name, what)
    for name in evidence.doubtful:
        verdict.find(name, "the patch and the sheet that it pressed are unknown")


def _judge_step(verdict: Verdict, evidence: Evidence, done: Done) -> None:
    found = evidence.files.get(done.file)
    verdict.files += 1
    # The merged file holds the same messages, so they are decoded only there.
    problems = [] if found is None else _problems(evidence, found, decode=evidence.state.closed is None)
    if changed := _changed(evidence.folder / done.file, done.sha256):
        why = verdict.damaged[done.file] = "; ".join(problems) or changed
        lost = Counter[str]() if found is None else Counter(done.counts) - found.counts
        words = ", ".join(f"{count} of {topic}" for topic, count in lost.items()) or "none"
        problems = [why if found is None else f"{why}; messages lost: {words}"]
    elif found is not None and dict(found.counts) != done.counts:
        problems.append(f"holds {dict(found.counts)}, but the journal says {done.counts}")
    verdict.find(done.file, *(f"({step_words(done)}) {problem}" for problem in problems))


def _judge_final(verdict: Verdict, evidence: Evidence, progress: Progress) -> None:
    """Judge the merged file; that of an open session was left by a close that was cut off or is not in the journal."""
    found, closed = evidence.files.get(evidence.final.name), evidence.state.closed
    verdict.files += closed is not None or found is not None
    if closed is not None and (changed := _changed(evidence.final, closed.sha256)):
        verdict.find(evidence.final.name, changed)
    if found is not None:
        problems = _problems(evidence, found, progress)
        if closed is not None and not problems and dict(found.counts) != closed.counts:
            problems = [f"holds {dict(found.counts)}, but the journal says {closed.counts}"]
        verdict.find(evidence.final.name, *problems)


def _problems(evidence: Evidence, found: McapFile, progress: Progress = unseen, *, decode: bool = True) -> list[str]:
    """What is wrong with the content of a file; nothing in one of another session is evidence."""
    return evidence.foreign(found) or [*found.damage, *(content_problems(found, progress) if decode else ())]


def _changed(path: Path, sha256: str) -> str:
    try:
        check_digest(path, sha256)
    except SessionDamaged as error:
        return error.what
    return ""


def _try_readers(verdict: Verdict, folder: Path) -> None:
    """Report as damage any error that `show` or a reader raises."""
    try:
        details(folder)
        if verdict.state == "closed":
            Recording(folder)
    except (InputError, SessionDamaged) as error:
        verdict.find(error.path.name, error.what)


def _count(verdict: Verdict, counts: Counter[str]) -> None:
    verdict.strokes, verdict.messages = counts[Topic.STROKE], counts.total()


def _repair_words(repair: Repaired | Lost) -> str:
    if isinstance(repair, Lost):
        return f"was lost: {repair.why}"
    missing = ", ".join(f"{count} of {topic}" for topic, count in repair.missing.items())
    return f"was repaired; missing: {missing or 'nothing'}"
