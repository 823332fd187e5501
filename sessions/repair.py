"""Repair a session: give back every stroke that one copy holds whole, mark the rest as lost, and say what was done.

Order: journal, configuration, steps, merged file. The file of a step and the merged file are two copies: a damaged step
is written again from the copy that holds most of it, and the merged file is merged again from the steps. A recording
without its session loses only the strokes of damaged chunks.

Nothing recorded is overwritten or deleted: a damaged original is kept as `<name>.damaged-1`. A repair that is
interrupted anywhere and started again ends with the same result.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

from brushloop.sessions.disk import file_sha256, fsync_folder, holds, set_aside
from brushloop.sessions.errors import disk_error
from brushloop.sessions.events import (
    Begin,
    BoardResult,
    CaptureResult,
    Done,
    Doubt,
    DrawResult,
    Event,
    JournalRepaired,
    Lost,
    PressResult,
    Repaired,
    line_of,
)
from brushloop.sessions.evidence import Evidence, gather, is_collected
from brushloop.sessions.journal import JOURNAL_NAME, Journal, Line, encode_line, read_header
from brushloop.sessions.mcap_file import McapFile, Part, Record, scan
from brushloop.sessions.recording import check_path, find_recording
from brushloop.sessions.records import BEGIN_NOTE, DONE_NOTE, REPAIRS_NOTE, StepEvent, Topic
from brushloop.sessions.salvage import (
    Report,
    Strokes,
    kept_words,
    lost_words,
    parsed,
    repair_file,
    replace_damaged,
    write_anew,
)
from brushloop.sessions.show import step_words
from brushloop.sessions.store import closed, lock, merge_session
from brushloop.sessions.verify import judge

MEASURED = (str(Topic.STILL), str(Topic.STROKE))
"""Topics without which a step is useless and is done again; a gap in any other topic is reported and accepted."""
Step = tuple[str, int]
"""Key and attempt of a step."""


def repair_session(path: Path, now_ns: Callable[[], int]) -> Report:
    """Repair a session's folder, or one MCAP file. Raises `SessionDamaged` if nothing can be rebuilt.

    `InputError` for anything that is not a session, `SessionLocked` while another process has the session open,
    `DiskFull` and `SessionError` if the disk fails.
    """
    target = path.resolve()
    try:
        check_path(path)
        if not is_collected(target):
            return repair_file(find_recording(path).resolve())
        held = lock(target)
        try:
            return _FolderRepair(gather(target), now_ns).run()
        finally:
            held.release()
    except OSError as error:
        raise disk_error(target, "cannot be repaired", error) from error


class _FolderRepair:
    """Repair of one folder while its lock is held."""

    def __init__(self, evidence: Evidence, now_ns: Callable[[], int]) -> None:
        self._evidence, self._verdict = evidence, judge(evidence)
        self._final_problems = self._verdict.problems(evidence.final.name)
        self._folder, self._final, self._state = evidence.folder, evidence.final, evidence.state
        self._now_ns = now_ns
        self._final_sound = evidence.state.closed is not None and not self._final_problems
        self._header = read_header(evidence.folder, evidence.state)
        self._report = Report(evidence.folder.name)
        self._lost_steps: list[str] = []
        """Reported as lost unless the merged file holds them."""
        self._begins = {event.file: event for event in evidence.events() if isinstance(event, Begin)}

    def run(self) -> Report:
        """Repair journal, configuration, steps and merged file."""
        report, state = self._report, self._state
        if not self._evidence.intact:
            self._rewrite_journal()
        self._journal = Journal(self._folder / JOURNAL_NAME, self._now_ns(), self._header.session_id)
        try:
            self._add_lines()
            self._snapshots()
            damaged = [step for step in state.files.values() if step.file in self._verdict.damaged]
            self._copies = self._copies_by_step() if damaged else {}
            for step in damaged:
                self._repair_step(step, self._verdict.damaged[step.file])
            for name, what in self._evidence.strays.items():
                kept = self._move_aside(self._folder / name)
                report.did.append(f"put {name} aside: it {what}{kept_words(kept)}")
                if name in self._begins and not self._final_sound:
                    self._lost_steps.append(f"{step_words(self._begins[name])}, whose file {what}")
            if state.closed is None and self._final_problems:
                kept = self._move_aside(self._final)
                report.did.append(f"put {self._final.name} aside, for which the journal has no close{kept_words(kept)}")
            elif state.closed is not None and not self._final_sound:
                self._merge_again()
        finally:
            self._journal.close()
        report.lost += self._lost_steps
        counts = state.counts() if state.closed is None else state.closed.counts
        report.strokes = counts.get(Topic.STROKE, 0)
        return report

    def _rewrite_journal(self) -> None:
        evidence, path = self._evidence, self._folder / JOURNAL_NAME
        aside = f"{path.name}.damaged" if path.exists() else ""
        note = JournalRepaired(t_ns=self._now_ns(), aside=aside, rebuilt=len(evidence.rebuilt), lost=evidence.lost)
        session = self._header.session_id
        lines = enumerate([*evidence.events(), note], 1)
        data = b"".join(encode_line(event.t_ns, line_of(event), number, session) for number, event in lines)
        kept = write_anew(path, data)
        report, lines = self._report, len(evidence.reading.entries)
        report.did.append(
            f"wrote {JOURNAL_NAME} again: {lines} lines as they were, {len(evidence.rebuilt)} rebuilt "
            f"from the files{kept_words(kept)}"
        )
        report.did += [f"  {JOURNAL_NAME}: {fault}" for fault in evidence.reading.faults]
        if evidence.lost:
            count = "1 line" if evidence.lost == 1 else f"{evidence.lost} lines"
            report.lost.append(f"{count} of {JOURNAL_NAME} that no file holds")

    def _add_lines(self) -> None:
        for event in self._evidence.rebuilt if self._evidence.intact else ():
            self._journal.append(event.t_ns, line_of(event))
            what = step_words(event) if isinstance(event, Begin | Done) else "the session"
            shown = getattr(event, "file", "the header")
            self._report.did.append(f"journalled {event.event!r} of {what}, which {shown} shows")
        sheet = self._state.sheet
        if sheet in self._state.doubtful_sheets:
            return
        for name in self._evidence.doubtful:
            self._log(Doubt(t_ns=self._now_ns(), sheet=sheet, file=name))
            self._report.lost.append(
                f"which patch {name} pressed: nothing more is pressed on sheet {sheet + 1}; "
                f"go on with a fresh one, --sheet {sheet + 2}"
            )

    def _snapshots(self) -> None:
        for name, text in ({} if self._state.opened is None else self._state.opened.snapshots).items():
            path = self._folder / name
            data = text.encode()
            if not holds(path, data):
                kept = write_anew(path, data)
                self._report.did.append(f"wrote {path.name} again from the journal{kept_words(kept)}")

    def _repair_step(self, step: Done, why: str) -> None:
        counts = Counter(step.counts)
        # A photograph without a stroke (the board) is found by the event of its step.
        needed = MEASURED if counts[Topic.STROKE] or not counts[Topic.STILL] else (*MEASURED, str(Topic.STEP))

        def worth(records: list[Record]) -> tuple[bool, int]:
            missing = counts - _count(records)
            return not any(topic in missing for topic in needed), len(records)

        copies = [records for records in self._copies_of(step) if _count(records) <= counts]
        records = max(copies, key=worth, default=list[Record]())
        missing = counts - _count(records)
        if any(topic in missing for topic in needed):
            self._lose(step, why)
        else:
            self._write_again(step, records, dict(missing), why)

    def _copies_by_step(self) -> dict[Step | int, list[tuple[McapFile, list[Part]]]]:
        """Files that hold a step, and the chunks of each, by the step that the file names inside, whatever its name.

        Of the merged file, also by the number of a still.
        """
        copies: dict[Step | int, list[tuple[McapFile, list[Part]]]] = defaultdict(list)
        aside = [scan(path) for path in sorted(self._folder.glob("*.mcap*.damaged-*"))]
        for found in [*self._evidence.files.values(), *aside]:
            if self._evidence.foreign(found):
                continue
            if found.path == self._final:
                for step, parts in _parts_by_step(found).items():
                    copies[step].append((found, parts))
            elif (step := _step_of(found)) is not None:
                copies[step].append((found, found.parts))
        return copies

    def _copies_of(self, step: Done) -> Iterator[list[Record]]:
        """What is intact of a step in each file."""
        ident, still = (step.key, step.attempt), None
        if isinstance(step.result, CaptureResult | BoardResult):
            still = step.result.still
        for found, parts in [*self._copies.get(ident, ()), *(self._copies.get(still, ()) if still is not None else ())]:
            records = found.messages(parts=parts)
            yield list(records) if found.path != self._final else list(_of_step(records, ident, still))

    def _write_again(self, step: Done, records: list[Record], missing: dict[str, int], why: str) -> None:
        path = self._folder / step.file
        # Without its `begin` in the journal, one is made from its `done`.
        begin = self._begins.get(step.file) or Begin(
            t_ns=step.t_ns,
            key=step.key,
            kind=step.kind,
            attempt=step.attempt,
            sheet=self._state.sheet,
            file=step.file,
        )
        begun = {"t_ns": begin.t_ns, **line_of(begin)}
        done = {name: value for name, value in line_of(step).items() if name in ("key", "attempt", "result")}
        counts = dict(_count(records))
        notes: dict[str, Line] = {BEGIN_NOTE: begun, DONE_NOTE: {"t_ns": step.t_ns, **done, "counts": counts}}
        kept, counts = replace_damaged(path, self._header, notes, {}, records)
        self._kept_as(path, kept)
        self._log(
            Repaired(
                t_ns=self._now_ns(),
                key=step.key,
                file=path.name,
                sha256=file_sha256(path),
                counts=counts,
                missing=missing,
                aside=kept,
                why=why,
            )
        )
        words = ", ".join(f"{count} of {topic}" for topic, count in missing.items())
        how = f"without {words}" if words else "whole"
        self._report.did.append(f"wrote {path.name} ({step_words(step)}) again {how}: {why}{kept_words(kept)}")
        if words:
            self._lost_steps.append(f"messages in {path.name} ({step_words(step)}): {words}")

    def _lose(self, step: Done, why: str) -> None:
        kept = self._move_aside(self._folder / step.file)
        again = "" if self._state.closed is not None else "; it is done again when the session goes on"
        self._log(Lost(t_ns=self._now_ns(), key=step.key, file=step.file, aside=kept, why=why))
        self._report.did.append(f"marked {step.file} ({step_words(step)}) as lost: {why}{kept_words(kept)}")
        self._lost_steps.append(f"{step_words(step)}{again}")
        if self._state.closed is None and isinstance(step.result, CaptureResult):
            self._lose_press(step.result.press.stroke_id)

    def _lose_press(self, stroke_id: str) -> None:
        """Mark the press of a lost photograph as lost too if its sheet was removed: it cannot be photographed again."""
        for step in list(self._state.files.values()):
            if not isinstance(step.result, PressResult | DrawResult) or step.result.press.stroke_id != stroke_id:
                continue
            sheet = step.result.press.sheet
            if sheet is not None and sheet != self._state.sheet:
                why = f"its photograph is lost and its sheet {sheet + 1} is no longer in"
                self._log(Lost(t_ns=self._now_ns(), key=step.key, file=step.file, why=why))
                self._report.did.append(f"marked {step.file} ({step_words(step)}) as lost: {why}")

    def _move_aside(self, path: Path) -> str:
        if not path.exists():
            return ""
        kept = set_aside(path, "damaged").name
        path.unlink()
        fsync_folder(self._folder)
        self._kept_as(path, kept)
        return kept

    def _kept_as(self, path: Path, kept: str) -> None:
        """Read what a file held from where it is kept: another step may be in it."""
        if kept and path.name in self._evidence.files:
            self._evidence.files[path.name].path = self._folder / kept

    def _merge_again(self) -> None:
        """Merge the steps' files again, or rewrite the damaged merged file where it holds more strokes."""
        found, strokes = self._evidence.files.get(self._final.name), self._state.counts().get(Topic.STROKE, 0)
        if found is not None and not self._evidence.foreign(found) and len(Strokes(found).kept) > strokes:
            self._lost_steps = self._rewrite_final(found)
            return
        why = "; ".join(self._final_problems)
        kept = set_aside(self._final, "damaged").name if self._final.is_file() else ""
        merge_session(self._folder, self._state, self._header, "damaged")
        self._log(closed(self._final, self._state.counts(), self._now_ns()))
        self._report.did.append(f"merged {self._final.name} again from the steps' files: it {why}{kept_words(kept)}")

    def _rewrite_final(self, found: McapFile) -> list[str]:
        """Rewrite the merged file, and return descriptions of what was lost."""
        strokes = Strokes(found)
        names = {} if self._state.opened is None else self._state.opened.snapshots
        files = {a.name: a.data for a in found.attachments()} | {name: text.encode() for name, text in names.items()}
        repairs = [line_of(repair) for repair in self._state.repairs]
        notes: dict[str, Line] = {REPAIRS_NOTE: {"repairs": repairs}} if repairs else {}
        kept, counts = replace_damaged(self._final, self._header, notes, files, strokes.messages())
        before = Counter[str]({} if self._state.closed is None else self._state.closed.counts)
        self._log(closed(self._final, counts, self._now_ns()))
        why = "; ".join(self._final_problems)
        self._report.did.append(f"wrote {self._final.name} again from what can be read of it: {why}{kept_words(kept)}")
        return lost_words(strokes, before, counts)

    def _log(self, event: Event) -> None:
        self._journal.append(event.t_ns, line_of(event))
        self._state.apply(event)


def _count(records: list[Record]) -> Counter[str]:
    return Counter(channel.topic for _schema, channel, _message in records)


def _step_of(found: McapFile) -> Step | None:
    """Key and attempt of the step recorded in a file, from its content, whatever its name."""
    for values in (found.notes.get(BEGIN_NOTE), found.notes.get(DONE_NOTE)):
        match values:
            case {"key": str(key), "attempt": int(attempt)}:
                return key, attempt
            case _:
                pass
    for _schema, _channel, message in found.messages(topics=(Topic.STEP,)):
        event = parsed(StepEvent, message)
        return None if event is None else (event.key, event.attempt)
    return None


def _parts_by_step(found: McapFile) -> dict[Step | int, list[Part]]:
    """Sound chunks of a merged file by the step, between its begin and end, and by the number of the still in them."""
    parts: dict[Step | int, list[Part]] = defaultdict(list)
    step: Step | None = None
    for part in found.parts:
        if not part.sound:
            step = None
            continue
        inside: set[Step | int] = set() if step is None else {step}
        for _schema, channel, message in found.messages(parts=[part], topics=(Topic.STEP, Topic.STILL, Topic.STROKE)):
            if channel.topic != Topic.STEP:
                inside.add(message.sequence)  # a stroke has that of its still
            elif (event := parsed(StepEvent, message)) is not None:
                inside.add((event.key, event.attempt))
                step = (event.key, event.attempt) if event.phase == "begin" else None
        for name in inside:
            parts[name].append(part)
    return parts


def _of_step(records: Iterator[Record], step: Step, still: int | None) -> Iterator[Record]:
    """The messages of one step among those of a merged file."""
    inside = False
    for record in records:
        _schema, channel, message = record
        event = parsed(StepEvent, message) if channel.topic == Topic.STEP else None
        if event is not None:
            inside = (event.key, event.attempt) == step
        if inside or (channel.topic in MEASURED and message.sequence == still):
            yield record
        if event is not None and event.phase == "end":
            inside = False
