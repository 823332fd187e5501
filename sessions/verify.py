"""Check whether a session is as it was recorded: every file is read again in full, and all damage is described."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.disk import SEGMENT_NAME, check_digest, holds
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError
from brushloop.sessions.events import Lost, Repaired
from brushloop.sessions.evidence import Evidence, full_line, gather, line_words
from brushloop.sessions.folders import check_name, not_a_session
from brushloop.sessions.journal import JOURNAL_NAME, Line
from brushloop.sessions.mcap_file import McapFile, scan
from brushloop.sessions.messages import decode_gray, decode_still
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import HEADER_METADATA, Stroke, Topic
from brushloop.sessions.show import details
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

    @property
    def sound(self) -> bool:
        """Whether nothing is damaged."""
        return not self.findings


def verify_session(path: Path, progress: Progress = unseen) -> Verdict:
    """Check a session's folder, or one MCAP file.

    Raises `InputError` where it is neither, is of another program, was renamed, or holds links.
    """
    check_name(path)
    if path.is_file():
        return _verify_file(path, path.name, progress)
    if not path.is_dir():
        raise not_a_session(path)
    name = path.resolve().name
    collected = (path / JOURNAL_NAME).is_file() or any(SEGMENT_NAME.fullmatch(p.name) for p in path.glob("*.mcap*"))
    if not collected:
        final = path / f"{name}.mcap"
        if not final.is_file():
            raise not_a_session(path)
        return _verify_file(final, name, progress)
    return _verify_folder(path.resolve(), progress)


def _verify_file(path: Path, name: str, progress: Progress) -> Verdict:
    verdict = Verdict(name, "recording", files=1)
    found, problems = file_problems(path, progress)
    if found.index is not None and HEADER_METADATA not in (one.name for one in found.index.metadata_indexes):
        raise InputError(path, f"is an MCAP file, but not a brushloop session: its index lists no {HEADER_METADATA}")
    verdict.findings += [Finding(path.name, problem) for problem in problems]
    if not problems:
        try:
            Recording(path)
        except SessionError as error:
            verdict.findings.append(Finding(path.name, error.what))
    _count(verdict, found.counts)
    return verdict


def _verify_folder(folder: Path, progress: Progress) -> Verdict:
    verdict = Verdict(folder.name, "open")
    try:
        evidence = gather(folder)
    except SessionDamaged as error:
        verdict.findings.append(Finding(error.path.name, error.what))
        return verdict
    _journal(verdict, evidence)
    state = evidence.state
    for step in counted(state.segments, "files of steps read", len(state.segments), progress):
        verdict.findings += _segment(verdict, evidence, full_line(step))
    for name, text in ({} if state.opened is None else state.opened.snapshots).items():
        path = folder / str(name)
        if not path.is_file():
            verdict.findings.append(Finding(str(name), "is missing, though the journal holds its text"))
        elif not holds(path, str(text).encode()):
            verdict.findings.append(Finding(str(name), "has changed since the session was started"))
    if state.closed is not None:
        verdict.state = "closed"
        _final(verdict, folder, evidence, progress)
    elif (final := folder / f"{folder.name}.mcap").is_file():
        # Left by an interrupted close, or by one whose line in the journal is lost.
        verdict.files += 1
        found, problems = file_problems(final)
        verdict.findings += [Finding(final.name, problem) for problem in _foreign(found, evidence) or problems]
    if verdict.sound:
        _shown(verdict, folder)
    _count(verdict, Counter(state.counts() if state.closed is None else state.closed.counts))
    verdict.notes += [f"{repair.file}: {_repair_words(repair)}" for repair in state.repairs]
    kept = [p for p in folder.iterdir() if ".damaged-" in p.name or ".superseded-" in p.name]
    if kept:
        verdict.notes.append(f"{len(kept)} damaged or replaced files are kept beside the session's own")
    return verdict


def _count(verdict: Verdict, counts: Counter[str]) -> None:
    verdict.strokes, verdict.messages = counts[Topic.STROKE], counts.total()


def _repair_words(repair: Repaired | Lost) -> str:
    if isinstance(repair, Lost):
        return f"was lost: {repair.why}"
    missing = ", ".join(f"{count} of {topic}" for topic, count in repair.missing.items())
    return f"was repaired; missing: {missing or 'nothing'}"


def _shown(verdict: Verdict, folder: Path) -> None:
    """Report as damage any error that `show` or a reader raises."""
    try:
        details(folder)
        if verdict.state == "closed":
            Recording(folder)
    except (InputError, SessionDamaged) as error:
        verdict.findings.append(Finding(error.path.name, error.what))


def _journal(verdict: Verdict, evidence: Evidence) -> None:
    verdict.findings += [Finding(JOURNAL_NAME, str(fault)) for fault in evidence.faults]
    if evidence.lost:
        verdict.notes.append(f"{JOURNAL_NAME}: {evidence.lost} of its lines cannot be rebuilt")
    elif evidence.faults:
        verdict.notes.append(f"{JOURNAL_NAME}: all of it can be rebuilt from the files")
    if evidence.data is None:
        verdict.findings.append(Finding(JOURNAL_NAME, "is missing, though the folder holds recordings"))
    if evidence.torn:
        verdict.notes.append(f"{JOURNAL_NAME}: its last line was cut off; the next process sets it aside")
    for line in evidence.rebuilt:
        match line["event"]:
            case "begin":
                verdict.findings.append(Finding(JOURNAL_NAME, f"does not mention {line['file']}"))
            case "done":
                verdict.notes.append(f"{line['file']}: {line_words(line)} is finished, but not journalled as done")
            case "closed":
                verdict.notes.append(f"{line['file']} is complete, but not journalled as closed")
            case _:
                verdict.findings.append(Finding(JOURNAL_NAME, "does not say how the session was opened"))
    for name in evidence.strays:
        verdict.findings.append(Finding(name, "holds a step that the journal lists under another file"))
    for name, session in evidence.foreign.items():
        verdict.findings.append(Finding(name, f"is of another session, {session[:100]!r}"))
    for name in evidence.doubtful:
        verdict.findings.append(Finding(name, "the patch and the sheet that it pressed are unknown"))


def _segment(verdict: Verdict, evidence: Evidence, line: Line) -> list[Finding]:
    path, step = evidence.folder / str(line["file"]), line_words(line)
    if line["file"] in evidence.state.held:
        return []
    verdict.files += 1
    try:
        check_digest(path, str(line["sha256"]))
    except SessionDamaged as error:
        if not path.is_file():
            return [Finding(path.name, f"({step}) {error.what}")]
        found, problems = file_problems(path)
        problems = _foreign(found, evidence) or problems
        lost = Counter[str](line["counts"]) - found.counts
        words = ", ".join(f"{count} of {topic}" for topic, count in lost.items()) or "none"
        why = "; ".join(problems) or error.what
        return [Finding(path.name, f"({step}) {why}; messages lost: {words}")]
    # The merged file holds the same messages, so they are decoded only there.
    found, problems = file_problems(path, decode=evidence.state.closed is None)
    if dict(found.counts) != line["counts"]:
        problems.append(f"holds {dict(found.counts)}, but the journal says {line['counts']}")
    return [Finding(path.name, f"({step}) {problem}") for problem in problems]


def _foreign(found: McapFile, evidence: Evidence) -> list[str]:
    """What is wrong with a file of another session: nothing in it is evidence."""
    session = found.session
    return [] if session in ("", evidence.session) else [f"is of another session, {session[:100]!r}"]


def _final(verdict: Verdict, folder: Path, evidence: Evidence, progress: Progress) -> None:
    state = evidence.state
    closed = state.closed
    assert closed is not None
    path = folder / f"{folder.name}.mcap"
    verdict.files += 1
    try:
        check_digest(path, closed.sha256)
    except SessionDamaged as error:
        verdict.findings.append(Finding(path.name, error.what))
    if not path.is_file():
        return
    found, problems = file_problems(path, progress)
    problems = _foreign(found, evidence) or problems
    expected = closed.counts
    if dict(found.counts) != expected and not problems:
        problems.append(f"holds {dict(found.counts)}, but the journal says {expected}")
    verdict.findings += [Finding(path.name, problem) for problem in problems]


def file_problems(path: Path, progress: Progress = unseen, *, decode: bool = True) -> tuple[McapFile, list[str]]:
    """Read a file in full and list what is wrong with its chunks, its index, its photographs and its strokes.

    Without `decode`, photographs and strokes are only checked by their CRC.
    """
    found = scan(path)
    problems = list(found.damage)
    stills: set[int] = set()
    strokes: set[str] = set()
    try:
        for _schema, channel, message in found.messages((Topic.STILL, Topic.STROKE) if decode else ()):
            if channel.topic == Topic.STILL:
                progress(f"{path.name}: photographs decoded", len(stills), found.counts[Topic.STILL])
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
    return found, problems
