"""Repair a session: give back every stroke that one copy holds whole, mark the rest as lost, and say what was done.

Order: journal, configuration, steps, merged file. The file of a step and the merged file are two copies: a damaged step
is written again from the copy that holds most of it, and the merged file is merged again from the steps. A recording
without its session loses only the strokes of damaged chunks.

Nothing recorded is overwritten or deleted: a damaged original is kept as `<name>.damaged-1`. A repair that is
interrupted anywhere and started again ends with the same result.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from brushloop.sessions.disk import SEGMENT_NAME, check_digest, file_sha256, fsync_folder, holds, set_aside
from brushloop.sessions.errors import SessionDamaged, SessionError, disk_error
from brushloop.sessions.events import DrawResult, PressResult, line_of, parse_event
from brushloop.sessions.evidence import Evidence, full_line, gather, line_words
from brushloop.sessions.folders import check_name, not_a_session
from brushloop.sessions.journal import JOURNAL_NAME, Journal, Line, encode_line, without_time
from brushloop.sessions.mcap_file import McapFile, Part, Record, scan
from brushloop.sessions.recording import REPAIRS_NOTE, count_messages, merge_session
from brushloop.sessions.records import (
    BEGIN_NOTE,
    DONE_NOTE,
    StepEvent,
    Stroke,
    Topic,
)
from brushloop.sessions.run_state import RunState, read_header, replay
from brushloop.sessions.salvage import (
    Report,
    kept_words,
    lost_words,
    parsed,
    repair_file,
    replace_damaged,
    with_their_stills,
    write_anew,
)
from brushloop.sessions.show import step_words
from brushloop.sessions.store import closed, lock
from brushloop.sessions.verify import file_problems

MEASURED = (str(Topic.STILL), str(Topic.STROKE))
"""Topics without which a step is useless and is done again; a gap in any other topic is reported and accepted."""


Step = tuple[str, int]
"""Key and attempt of a step."""


def repair_session(path: Path, now_ns: Callable[[], int]) -> Report:
    """Repair a session's folder, or one MCAP file. Raises `SessionDamaged` if nothing can be rebuilt.

    `InputError` for anything that is not a session, and for a renamed folder, which needs no repair.
    `SessionLocked` while another process has the session open, `DiskFull` and `SessionError` if the disk fails.
    """
    target = path.resolve()
    if not target.exists():
        raise not_a_session(path)
    try:
        check_name(path)
        if target.is_file():
            return repair_file(target)
        files = [file.name for file in target.glob("*.mcap*")]
        if not (target / JOURNAL_NAME).exists() and not any(map(SEGMENT_NAME.fullmatch, files)):
            final = target / f"{target.name}.mcap"
            if not final.is_file():
                raise not_a_session(path)
            return repair_file(final)
        held = lock(target)
        try:
            return FolderRepair(target, now_ns).run()
        finally:
            held.release()
    except OSError as error:
        raise disk_error(target, "cannot be repaired", error) from error


class FolderRepair:
    """Repair of one folder while its lock is held."""

    def __init__(self, folder: Path, now_ns: Callable[[], int]) -> None:
        self._folder = folder
        self._final = folder / f"{folder.name}.mcap"
        self._now_ns = now_ns
        self._report = Report(folder.name)
        self._lost_steps: list[str] = []
        """Reported as lost unless the merged file holds them."""
        self._scans: dict[tuple[int, int, int], tuple[McapFile, Step | None]] = {}
        """Content of each file that was read and the step it belongs to, by inode, size and time."""
        evidence = gather(folder)
        self._strays = dict.fromkeys(evidence.strays, "it is a copy of another step")
        self._strays |= {name: f"it is of another session, {other!r}" for name, other in evidence.foreign.items()}
        self._begins = [line for line in evidence.all_lines if line["event"] == "begin"]
        self._header = read_header(folder, evidence.state)
        self._journal = _repaired_journal(evidence, self._header.session_id, now_ns, self._report)
        try:
            self._state = replay(folder / JOURNAL_NAME)
            self._final_sound = _final_is_sound(folder, self._state)
            self._merged: tuple[dict[Step, list[Part]], dict[int, list[Part]]] | None = None
        except BaseException:
            self._journal.close()
            raise

    def run(self) -> Report:
        """Repair configuration, steps and merged file."""
        try:
            self._snapshots()
            for step in self._state.segments:
                self._segment(full_line(step))
            for name, why in self._strays.items():
                kept = self._move_aside(self._folder / name)
                self._report.did.append(f"put {name} aside: {why}{kept_words(kept)}")
            if self._state.closed is None:
                self._left_by_a_close()
            elif not self._final_sound:
                self._merge_again()
        finally:
            self._journal.close()
        self._report.lost += self._lost_steps
        counts = self._state.counts() if self._state.closed is None else self._state.closed.counts
        self._report.strokes = counts.get(Topic.STROKE, 0)
        return self._report

    def _snapshots(self) -> None:
        for name, text in ({} if self._state.opened is None else self._state.opened.snapshots).items():
            path = self._folder / name
            data = text.encode()
            if not holds(path, data):
                kept = write_anew(path, data)
                self._report.did.append(f"wrote {path.name} again from the journal{kept_words(kept)}")

    def _segment(self, line: Line) -> None:
        path = self._folder / line["file"]
        if line["file"] in self._state.held and self._final_sound:
            return
        try:
            check_digest(path, str(line["sha256"]))
        except SessionDamaged as error:
            self._damaged(path, line, error.what)

    def _damaged(self, path: Path, line: Line, why: str) -> None:
        if path.is_file():
            why = "; ".join(self._look(path)[0].damage) or why
        counts = Counter[str](line["counts"])
        needed = _needed(counts)

        def worth(records: list[Record]) -> tuple[bool, int]:
            missing = counts - _count(records)
            return not any(topic in missing for topic in needed), len(records)

        copies = [records for records in self._copies(path, line) if _count(records) <= counts]
        records = max(copies, key=worth, default=list[Record]())
        missing = counts - _count(records)
        if missing and self._final_sound:
            kept = self._move_aside(path)
            self._log({"event": "held", "key": line["key"], "file": path.name, "by": self._final.name, "why": why})
            held = f"{path.name} ({line_words(line)}) {why}: the merged file holds all of it{kept_words(kept)}"
            self._report.did.append(held)
        elif any(topic in missing for topic in needed):
            self._lose(path, line, why)
        else:
            self._write_again(path, line, records, dict(missing), why)

    def _copies(self, path: Path, line: Line) -> Iterator[list[Record]]:
        """What is intact of a step in each file that names it inside, whatever its name, and in the merged file."""
        step: Step = line["key"], line["attempt"]
        others = (other for other in sorted(self._folder.glob("*.mcap*")) if other not in (path, self._final))
        for file in (path, *others):
            if file.is_file():
                found, whose = self._look(file)
                if whose == step:
                    yield list(found.messages())
        if not self._final.is_file():
            return
        found = self._look(self._final)[0]
        if self._is_ours(found):
            self._merged = self._merged or _steps_in(found)
            by_step, by_still = self._merged
            yield list(found.messages(parts=by_step.get(step, [])))
            yield list(found.messages(parts=by_still.get(line["result"].get("still"), [])))

    def _look(self, path: Path) -> tuple[McapFile, Step | None]:
        """Read the content of a file and the step it belongs to; only once, even if the file is renamed meanwhile."""
        stat = path.stat()
        known = (stat.st_ino, stat.st_size, stat.st_mtime_ns)
        if known not in self._scans:
            found = scan(path)
            whole = path == self._final or not self._is_ours(found)
            self._scans[known] = found, None if whole else _step_of(found)
        self._scans[known][0].path = path
        return self._scans[known]

    def _is_ours(self, found: McapFile) -> bool:
        """Whether a file may be evidence. Steps of another session of the same protocol have the same keys."""
        return found.session in ("", self._header.session_id)

    def _write_again(self, path: Path, line: Line, records: list[Record], missing: dict[str, int], why: str) -> None:
        begin = {"t_ns": line["t_ns"], "header": self._header.model_dump(mode="json"), "line": self._begin_of(line)}
        if path.is_file():
            found, whose = self._look(path)
            begin = found.notes.get(BEGIN_NOTE, begin) if whose == (line["key"], line["attempt"]) else begin
        counts = dict(_count(records))
        done = {name: line[name] for name in ("key", "result", "t_ns")}
        notes = {BEGIN_NOTE: begin, DONE_NOTE: {**done, "attempt": line["attempt"], "counts": counts}}
        kept, counts = replace_damaged(path, self._header, notes, {}, records)
        event: Line = {"event": "repaired", "key": line["key"], "file": path.name, "sha256": file_sha256(path)}
        self._log({**event, "counts": counts, "missing": missing, "aside": kept, "why": why})
        words = ", ".join(f"{count} of {topic}" for topic, count in missing.items())
        how = f"without {words}" if words else "whole"
        self._report.did.append(f"wrote {path.name} ({line_words(line)}) again {how}: {why}{kept_words(kept)}")
        if words:
            self._lost_steps.append(f"messages in {path.name} ({line_words(line)}): {words}")

    def _begin_of(self, line: Line) -> Line:
        """The attempt's `begin` line in the journal; without one, a line made from its `done` line."""
        for begin in self._begins:
            if begin["file"] == line["file"]:
                return without_time(begin)
        known = {"event": "begin", "key": line["key"], "kind": line["result"]["kind"], "attempt": line["attempt"]}
        return {**known, "sheet": self._state.sheet, "file": line["file"]}

    def _lose(self, path: Path, line: Line, why: str) -> None:
        kept = self._move_aside(path)
        again = "" if self._state.closed is not None else "; it is done again when the session goes on"
        self._log({"event": "lost", "key": line["key"], "file": path.name, "aside": kept, "why": why})
        self._report.did.append(f"marked {path.name} ({line_words(line)}) as lost: {why}{kept_words(kept)}")
        self._lost_steps.append(f"{line_words(line)}{again}")
        if self._state.closed is None:
            self._lose_its_press(line)

    def _lose_its_press(self, line: Line) -> None:
        """Mark the press as lost too if its sheet was removed: it cannot be photographed again."""
        stroke = line["result"].get("press", {}).get("stroke_id")
        for other in self._state.segments:
            if not isinstance(other.result, PressResult | DrawResult) or other.result.press.stroke_id != stroke:
                continue
            sheet = other.result.press.sheet
            if sheet is not None and sheet != self._state.sheet:
                why = f"its photograph is lost and its sheet {sheet + 1} is no longer in"
                self._log({"event": "lost", "key": other.key, "file": other.file, "aside": "", "why": why})
                self._report.did.append(f"marked {other.file} ({step_words(other)}) as lost: {why}")

    def _move_aside(self, path: Path) -> str:
        if not path.exists():
            return ""
        kept = set_aside(path, "damaged")
        path.unlink()
        fsync_folder(self._folder)
        return kept.name

    def _merge_again(self) -> None:
        """Merge the steps' files again, or rewrite the damaged merged file where it holds more strokes."""
        found = self._look(self._final)[0] if self._final.is_file() else None
        if (
            found is not None
            and self._is_ours(found)
            and len(with_their_stills(found).kept) > self._state.counts().get(Topic.STROKE, 0)
        ):
            self._lost_steps = self._rewrite_final(found)
            return
        why = "is missing" if found is None else "; ".join(found.damage) or "has changed"
        kept = set_aside(self._final, "damaged").name if self._final.is_file() else ""
        merge_session(self._folder, self._state, self._header, "damaged")
        self._log(line_of(closed(self._final, self._state.counts(), 0)))
        self._report.did.append(f"merged {self._final.name} again from the steps' files: it {why}{kept_words(kept)}")

    def _rewrite_final(self, found: McapFile) -> list[str]:
        """Rewrite the merged file, and return descriptions of what was lost."""
        strokes = with_their_stills(found)
        names = {} if self._state.opened is None else self._state.opened.snapshots
        files = {a.name: a.data for a in found.attachments()} | {name: text.encode() for name, text in names.items()}
        repairs = [line_of(repair) for repair in self._state.repairs]
        notes: dict[str, Line] = {REPAIRS_NOTE: {"repairs": repairs}} if repairs else {}
        kept, counts = replace_damaged(self._final, self._header, notes, files, strokes.messages())
        before = Counter[str]({} if self._state.closed is None else self._state.closed.counts)
        self._log(line_of(closed(self._final, counts, 0)))
        why = "; ".join(found.damage) or "has changed"
        self._report.did.append(f"wrote {self._final.name} again from what can be read of it: {why}{kept_words(kept)}")
        return lost_words(strokes, before, counts)

    def _left_by_a_close(self) -> None:
        """Put aside a damaged merged file of an open session, which is merged again when it closes."""
        if not self._final.is_file():
            return
        found, problems = file_problems(self._final)
        if problems or not self._is_ours(found):
            kept = self._move_aside(self._final)
            self._report.did.append(
                f"put {self._final.name} aside, for which the journal has no close{kept_words(kept)}"
            )

    def _log(self, line: Line) -> None:
        t_ns = self._now_ns()
        self._journal.append(t_ns, line)
        self._state.apply(parse_event({"t_ns": t_ns, **line}))


def _needed(counts: Counter[str]) -> tuple[str, ...]:
    """Topics that a step needs; a photograph without a stroke (the board) is found by the event of its step."""
    return MEASURED if counts[Topic.STROKE] or not counts[Topic.STILL] else (*MEASURED, str(Topic.STEP))


def _final_is_sound(folder: Path, state: RunState) -> bool:
    """Whether the merged file is unchanged since the close, and reads back with every CRC."""
    final = folder / f"{folder.name}.mcap"
    if state.closed is None or not final.is_file():
        return False
    try:
        if file_sha256(final) != state.closed.sha256:
            return False
        return count_messages(final) == state.closed.counts and not file_problems(final)[1]
    except (SessionError, OSError):
        return False


def _count(records: list[Record]) -> Counter[str]:
    return Counter(channel.topic for _schema, channel, _message in records)


def _step_of(found: McapFile) -> Step | None:
    """Key and attempt of the step recorded in a file, from its content, whatever its name."""
    for values in (found.notes.get(BEGIN_NOTE, {}).get("line"), found.notes.get(DONE_NOTE)):
        match values:
            case {"key": str(key), "attempt": int(attempt)}:
                return key, attempt
            case _:
                pass
    for _schema, _channel, message in found.messages((Topic.STEP,)):
        event = parsed(StepEvent, message)
        return None if event is None else (event.key, event.attempt)
    return None


def _steps_in(found: McapFile) -> tuple[dict[Step, list[Part]], dict[int, list[Part]]]:
    """Sound chunks of a damaged merged file by step, and those with a photograph and its stroke by the still's number.

    A step lies between its begin and end events. Chunks between damage and the next event belong to the step of that
    event if it ends there.
    """
    by_step: dict[Step, list[Part]] = {}
    by_still: dict[int, list[Part]] = {}
    run: list[Part] = []
    for part in found.parts:
        if not part.sound:
            run = []
            continue
        run = [*run, part]
        step: Step | None = None
        for _schema, channel, message in found.messages((Topic.STEP, Topic.STILL, Topic.STROKE), [part]):
            if channel.topic == Topic.STEP and (event := parsed(StepEvent, message)) is not None:
                step = event.key, event.attempt
                run = [part] if event.phase == "begin" else run
            elif channel.topic == Topic.STILL:
                by_still.setdefault(message.sequence, []).append(part)
            elif channel.topic == Topic.STROKE and (stroke := parsed(Stroke, message)) is not None:
                parts = by_still.setdefault(stroke.still, [])
                parts += [] if part in parts else [part]
        if step is not None:
            known = by_step.get(step, [])
            run = by_step[step] = [*known, *(part for part in run if part not in known)]
    return by_step, by_still


def _repaired_journal(evidence: Evidence, session: str, now_ns: Callable[[], int], report: Report) -> Journal:
    """Repair the session's journal and open it for further lines. Raises `SessionError`."""
    if not evidence.intact:
        _rewrite_journal(evidence, session, now_ns, report)
    journal = Journal(evidence.folder / JOURNAL_NAME, now_ns(), session)
    try:
        _add_lines(journal, evidence, now_ns, report)
    except BaseException:
        journal.close()
        raise
    return journal


def _rewrite_journal(evidence: Evidence, session: str, now_ns: Callable[[], int], report: Report) -> None:
    path = evidence.folder / JOURNAL_NAME
    aside = f"{path.name}.damaged" if path.exists() else ""
    words = {"event": "journal", "aside": aside, "rebuilt": len(evidence.rebuilt), "lost": evidence.lost}
    lines = [*evidence.all_lines, {"t_ns": now_ns(), **words}]
    data = (encode_line(int(line.get("t_ns", 0)), without_time(line), n, session) for n, line in enumerate(lines, 1))
    kept = write_anew(path, b"".join(data))
    report.did.append(
        f"wrote {JOURNAL_NAME} again: {len(evidence.lines)} lines as they were, {len(evidence.rebuilt)} rebuilt "
        f"from the files{kept_words(kept)}"
    )
    report.did += [f"  {JOURNAL_NAME}: {fault}" for fault in evidence.faults]
    if evidence.lost:
        count = "1 line" if evidence.lost == 1 else f"{evidence.lost} lines"
        report.lost.append(f"{count} of {JOURNAL_NAME} that no file holds")


def _add_lines(journal: Journal, evidence: Evidence, now_ns: Callable[[], int], report: Report) -> None:
    if evidence.intact:
        for line in evidence.rebuilt:
            journal.append(int(line["t_ns"]), without_time(line))
            what = line_words(line) if line["event"] != "closed" else "the session"
            shown = str(line.get("file", "the header"))
            report.did.append(f"journalled {line['event']!r} of {what}, which {shown} shows")
    sheet = evidence.state.sheet
    if evidence.doubtful and sheet not in evidence.state.doubtful_sheets:
        for name in evidence.doubtful:
            journal.append(now_ns(), {"event": "doubt", "file": name, "sheet": sheet})
            report.lost.append(
                f"which patch {name} pressed: nothing more is pressed on sheet {sheet + 1}; "
                f"go on with a fresh one, --sheet {sheet + 2}"
            )
