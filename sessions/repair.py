"""Repair a session: give back every stroke that one copy holds whole, mark the rest as lost, and say what was done.

Order: journal, configuration, steps, merged file. The file of a step and the merged file are two copies: a damaged step
is written again from the copy that holds most of it, and the merged file is merged again from the steps. A recording
without its session is the only copy: it loses the strokes of its damaged chunks, and nothing else.

Nothing recorded is overwritten or deleted: a damaged original is kept as `<name>.damaged-1`. A repair that is
interrupted anywhere and started again ends with the same result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from brushloop.sessions import events
from brushloop.sessions.disk import file_sha256, fsync_folder, holds, set_aside, write_durably
from brushloop.sessions.errors import SessionDamaged, disk_error
from brushloop.sessions.events import Begin, Done, Event, step_words
from brushloop.sessions.journal import JOURNAL_NAME, Journal, encode_line, read_header
from brushloop.sessions.mcap_file import McapFile, Record
from brushloop.sessions.mcap_writer import Outgoing, new_mcap
from brushloop.sessions.recording import check_path, find_recording, parse_header
from brushloop.sessions.records import HEADER_FILE, Header, Stroke, Topic
from brushloop.sessions.store import closed, lock, merge_session, step_message
from brushloop.sessions.verify import (
    UNKNOWN_PATCH,
    Evidence,
    count_words,
    gather,
    is_collected,
    judge,
    parsed_step,
    verify_session,
)

MEASURED = (str(Topic.STILL), str(Topic.STROKE))
"""Topics without which a step is useless and is done again; a gap in any other topic is reported and accepted."""


@dataclass(slots=True)
class Report:
    """Result of a repair."""

    session: str
    did: list[str] = field(default_factory=list[str])
    lost: list[str] = field(default_factory=list[str])
    """Descriptions of what could not be recovered; empty for a repair without loss."""
    strokes: int = 0
    """Finished strokes in the session after the repair."""


def repair_session(path: Path, now_ns: Callable[[], int]) -> Report:
    """Repair a session's folder, or one MCAP file. Raises `SessionDamaged` if nothing can be rebuilt.

    `InputError` for anything that is not a session, `SessionLocked` while another process has the session open,
    `DiskFull` and `SessionError` if the disk fails.
    """
    target = path.resolve()
    try:
        check_path(path)
        if not is_collected(target):
            return _repair_file(find_recording(path).resolve())
        held = lock(target)
        try:
            return _FolderRepair(gather(target), now_ns).run()
        finally:
            held.release()
    except OSError as error:
        raise disk_error(target, "cannot be repaired", error) from error


def _repair_file(path: Path) -> Report:
    """Repair one MCAP file, an import or a merged file without its session, from what can be read of it.

    Raises `SessionDamaged`.
    """
    verdict = verify_session(path)
    report = Report(path.name, strokes=verdict.strokes)
    if verdict.sound:
        return report
    file, lost = McapFile(path, check=True), report.lost
    if file.header is None:
        raise SessionDamaged(path, "has lost its header; it cannot be repaired")
    if not file.session:
        lost.append("proof that the header is right: it does not match its CRC, and was kept as it was read")
    strokes: dict[str, bool] = {}
    attached = {one.name: one.data for one in file.attachments() if one.name != HEADER_FILE}
    kept, counts = _replace_damaged(path, parse_header(file), _whole(file, strokes), attached)
    why = "; ".join(what for problems in verdict.findings.values() for what in problems)
    report.did.append(f"wrote {path.name} again from its readable parts: {why}{kept}")
    report.strokes = counts.get(Topic.STROKE, 0)
    lost += [f"stroke {name}: its photograph is lost" for name, whole in strokes.items() if not whole]
    gone = file.stated - Counter(counts)
    gone[Topic.STROKE] -= list(strokes.values()).count(False)
    lost += [f"messages on {topic}: {count}" for topic, count in gone.items() if count > 0]
    if file.index is None and len(file.damage) > 1:
        lost.append("an unknown number of messages behind the damage, as the file has no index")
    if file.index is not None:
        names = {one.name for one in file.index.attachment_indexes} - {HEADER_FILE, *attached}
        lost += [f"the attached file {name}" for name in sorted(names)]
    return report


class _FolderRepair:
    """Repair of one folder while its lock is held."""

    def __init__(self, evidence: Evidence, now_ns: Callable[[], int]) -> None:
        self._evidence, self._verdict = evidence, judge(evidence)
        self._folder, self._final, self._state = evidence.folder, evidence.final, evidence.state
        self._final_problems = self._verdict.findings.get(evidence.final.name, [])
        self._now_ns = now_ns
        self._header = read_header(evidence.folder, evidence.state)
        self._report = Report(evidence.folder.name)
        self._begins = {event.file: event for event in evidence.events() if isinstance(event, Begin)}

    def run(self) -> Report:
        """Repair journal, configuration, steps and merged file."""
        report, state = self._report, self._state
        if self._evidence.reading.faults or self._evidence.reading.torn or self._evidence.rebuilt:
            self._rewrite_journal()
        self._journal = Journal(self._folder / JOURNAL_NAME, self._header.session_id)
        try:
            self._snapshots()
            self._repair_steps()
            self._put_strays_aside()
            if state.closed is None and self._final_problems and self._final.exists():
                kept = self._move_aside(self._final)
                report.did.append(f"put {self._final.name} aside, as the journal has no closing line{kept}")
            elif state.closed is not None and self._final_problems:
                self._merge_again()
        finally:
            self._journal.close()
        counts = state.counts() if state.closed is None else state.closed.counts
        report.strokes = counts.get(Topic.STROKE, 0)
        return report

    def _rewrite_journal(self) -> None:
        evidence, session, report = self._evidence, self._header.session_id, self._report
        lines = (encode_line(event, n, session) for n, event in enumerate(evidence.events(), 1))
        kept = _write_anew(self._folder / JOURNAL_NAME, b"".join(lines))
        as_they_were, rebuilt = len(evidence.reading.events), len(evidence.rebuilt)
        what = f"{as_they_were} lines unchanged, {rebuilt} rebuilt from the files"
        report.did.append(f"wrote {JOURNAL_NAME} again: {what}{kept}")
        report.did += [f"  {JOURNAL_NAME}: {fault}" for fault in evidence.reading.faults]
        if evidence.lost:
            report.lost.append(f"lines of {JOURNAL_NAME} that cannot be rebuilt: {evidence.lost}")

    def _put_strays_aside(self) -> None:
        sheet = self._state.sheet
        for name, what in self._evidence.strays.items():
            if what == UNKNOWN_PATCH and sheet not in self._state.doubtful_sheets:
                self._log(events.Doubt(t_ns=self._now_ns(), sheet=sheet, file=name))
                self._report.lost.append(
                    f"the patch number of the press in {name}: nothing more is pressed on sheet {sheet + 1}; "
                    f"continue with a fresh sheet and --sheet {sheet + 2}"
                )
            self._report.did.append(f"put {name} aside: it {what}{self._move_aside(self._folder / name)}")
            if name in self._begins:
                self._report.lost.append(f"{step_words(self._begins[name])}, whose file {what}")

    def _snapshots(self) -> None:
        for name, text in ({} if self._state.opened is None else self._state.opened.snapshots).items():
            if not holds(self._folder / name, text.encode()):
                kept = _write_anew(self._folder / name, text.encode())
                self._report.did.append(f"wrote {name} again from the journal{kept}")

    def _repair_steps(self) -> None:
        """Write each damaged step again from the copy that holds most of it, or mark it as lost."""
        damaged = {step.file: step for step in self._state.files.values() if step.file in self._verdict.damaged}
        best: dict[str, list[Record]] = {file: [] for file in damaged}
        for step, records in self._copies(damaged):
            if step.file in best and _worth(step, records) > _worth(step, best[step.file]):
                best[step.file] = records
                if _count(records) == Counter(step.counts):
                    self._write_again(step, best.pop(step.file))  # one photograph in memory
        for file, records in best.items():
            if _worth(damaged[file], records)[0]:
                self._write_again(damaged[file], records)
            else:
                self._lose(damaged[file])

    def _copies(self, damaged: Mapping[str, Done]) -> Iterator[tuple[Done, list[Record]]]:
        """What is intact of damaged steps in each file of the session, whatever its name."""
        steps: dict[object, Done] = {}
        for step in damaged.values():
            steps[step.key, step.attempt] = step
            if isinstance(step.result, events.CaptureResult | events.BoardResult):
                steps[step.result.still] = step
        # Those kept aside come last: what was replaced just now is among them.
        for pattern in ("*.mcap", "*.mcap.damaged-*") if steps else ():
            for path in sorted(self._folder.glob(pattern)):
                file = McapFile(path, check=True)
                if file.session in ("", self._evidence.session):
                    yield from _in_steps(file, steps)

    def _write_again(self, step: Done, records: list[Record]) -> None:
        path, why = self._folder / step.file, self._verdict.damaged[step.file]
        begin, end = self._begins[step.file], step.model_copy(update={"sha256": ""})
        kept, counts = _replace_damaged(path, self._header, [step_message(begin), *records, step_message(end)])
        missing = dict(Counter(step.counts) - Counter(counts))
        t_ns, sha256 = self._now_ns(), file_sha256(path)
        self._log(events.Repaired(t_ns=t_ns, file=step.file, sha256=sha256, counts=counts, missing=missing, why=why))
        how = f"without {count_words(missing)}" if missing else "in full"
        self._report.did.append(f"wrote {step.file} ({step_words(step)}) again {how}: {why}{kept}")
        if missing:
            self._report.lost.append(f"messages in {step.file} ({step_words(step)}): {count_words(missing)}")

    def _lose(self, step: Done) -> None:
        kept = self._move_aside(self._folder / step.file)
        self._mark_lost(step, self._verdict.damaged[step.file], kept)
        again = "" if self._state.closed is not None else "; the step is repeated when the session is resumed"
        self._report.lost.append(f"{step_words(step)}{again}")
        if self._state.closed is not None or not isinstance(step.result, events.CaptureResult):
            return
        # If its sheet was removed, the stroke cannot be photographed again: its press is lost too.
        for done in list(self._state.files.values()):
            press = done.press if isinstance(done.result, events.PressResult) else None
            if press is None or press.stroke_id != step.result.press.stroke_id:
                continue
            if press.sheet is not None and press.sheet != self._state.sheet:
                self._mark_lost(done, f"its photograph is lost and its sheet {press.sheet + 1} is no longer in place")

    def _mark_lost(self, step: Done, why: str, kept: str = "") -> None:
        self._log(events.Lost(t_ns=self._now_ns(), file=step.file, why=why))
        self._report.did.append(f"marked {step.file} ({step_words(step)}) as lost: {why}{kept}")

    def _move_aside(self, path: Path) -> str:
        if not path.exists():
            return ""
        kept = _keep(path)
        path.unlink()
        fsync_folder(self._folder)
        return kept

    def _merge_again(self) -> None:
        kept = _keep(self._final)
        merge_session(self._folder, self._state, self._header, "damaged")
        self._log(closed(self._final, self._state.counts(), self._now_ns()))
        why = "; ".join(self._final_problems)
        self._report.did.append(f"wrote {self._final.name} again from the steps' files: {why}{kept}")

    def _log(self, event: Event) -> None:
        self._journal.append(event)
        self._state.apply(event)


def _whole(file: McapFile, strokes: dict[str, bool]) -> Iterator[Record]:
    """Everything readable, but no stroke without its photograph or for the second time; `strokes` says which came."""
    stills: set[int] = set()
    for schema, channel, message in file.messages():
        if channel.topic == Topic.STILL:
            stills.add(message.sequence)
        elif channel.topic == Topic.STROKE:
            try:
                stroke = Stroke.model_validate_json(message.data)
            except ValidationError:
                continue
            whole = stroke.still in stills and not strokes.get(stroke.stroke_id)
            strokes[stroke.stroke_id] = whole or strokes.get(stroke.stroke_id, False)
            if not whole:
                continue
        yield schema, channel, message


def _in_steps(file: McapFile, damaged: Mapping[object, Done]) -> Iterator[tuple[Done, list[Record]]]:
    """What is readable of damaged steps in a file, without the messages of their begin and end.

    They are found by their key and attempt, or by the number of a still: their begin, their end or both may be lost.
    """
    records, step, over = list[Record](), None, False
    for record in file.messages():
        _schema, channel, message = record
        event = parsed_step(message.data) if channel.topic == Topic.STEP else None
        if over or isinstance(event, Begin):
            if step is not None:
                yield step, records
            records, step = [], None
        over = isinstance(event, Done)
        if event is not None:
            step = step or damaged.get((event.key, event.attempt))
        else:
            records.append(record)
            step = step or (damaged.get(message.sequence) if channel.topic == Topic.STILL else None)
    if step is not None:
        yield step, records


def _worth(step: Done, records: list[Record]) -> tuple[bool, int]:
    """How good a copy of a step is: whether it will do, and how many messages it holds."""
    counts, present = Counter(step.counts), _count(records)
    return present <= counts and not any(topic in counts - present for topic in MEASURED), len(records)


def _count(records: list[Record]) -> Counter[str]:
    """Messages of a step by topic, those of its begin and end among them."""
    return Counter({str(Topic.STEP): 2}) + Counter(channel.topic for _schema, channel, _message in records)


def _replace_damaged(
    path: Path,
    header: Header,
    messages: Iterable[Record | Outgoing],
    attached: Mapping[str, bytes] | None = None,
) -> tuple[str, dict[str, int]]:
    """Write a file with these contents in place of `path`, and keep the damaged one beside it.

    Returns where that is, and the messages by topic as read back. Raises `SessionError`; the damaged file then still
    has its own name.
    """
    fresh = path.with_name(path.name + ".repair")
    try:
        fresh.unlink(missing_ok=True)  # left by a killed repair: only a copy
        with new_mcap(fresh, header, attached or {}) as writer:
            for message in messages:
                if isinstance(message, Outgoing):
                    writer.record(message)
                else:
                    writer.copy(*message)
        counts = dict(McapFile(fresh, check=True).sound().counts)
        return _put_in_place(fresh, path), counts
    except OSError as error:
        raise disk_error(path, "cannot write its repaired copy", error) from error


def _write_anew(path: Path, data: bytes) -> str:
    """Replace a file; returns where the damaged one is kept. Raises `OSError`."""
    fresh = path.with_name(path.name + ".repair")
    fresh.unlink(missing_ok=True)
    write_durably(fresh, data)
    return _put_in_place(fresh, path)


def _put_in_place(fresh: Path, path: Path) -> str:
    kept = _keep(path)
    fresh.replace(path)
    fsync_folder(path.parent)
    return kept


def _keep(path: Path) -> str:
    """Give the damaged file, if there is one, a second name, and say which."""
    return f"; the damaged file is kept as {set_aside(path, 'damaged').name}" if path.exists() else ""
