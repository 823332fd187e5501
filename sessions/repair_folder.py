"""The repair of a session's folder: journal first, then configuration, steps, and the merged file."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import ValidationError

from sessions.disk import set_aside
from sessions.errors import SessionDamaged
from sessions.evidence import Evidence, final_is_sound, gather
from sessions.journal import JOURNAL_NAME, Journal, fold, fsync_folder, replay
from sessions.lines import Line, encode_line
from sessions.merge import REPAIRS_NOTE, verify
from sessions.rewrite import replace_damaged, with_their_stills
from sessions.salvage import Scan, salvaged, scan
from sessions.schemas import StepEvent, Topic
from sessions.store import closed_line, counts_of, merge_session, read_header
from sessions.verify import step_words
from sessions.writer import BEGIN_NOTE, DONE_NOTE, file_sha256

MEASURED = (str(Topic.STILL), str(Topic.STROKE))
"""Without these a step is worth nothing and is done again; a gap in anything else is told and kept."""


@dataclass(slots=True)
class Report:
    """What a repair did."""

    session: str
    did: list[str] = field(default_factory=list[str])
    lost: list[str] = field(default_factory=list[str])
    """What could not be given back, in words; empty for a repair without loss."""
    strokes: int = 0
    """Finished strokes that the session now holds."""

    @property
    def lossless(self) -> bool:
        """Whether everything recorded was given back."""
        return not self.lost


class FolderRepair:
    """One repair of one folder, its lock held."""

    def __init__(self, folder: Path, now_ns: Callable[[], int]) -> None:
        self._folder = folder
        self._final = folder / f"{folder.name}.mcap"
        self._now_ns = now_ns
        self._report = Report(folder.name)
        self._lost_steps: list[str] = []
        """Told as lost unless the merged file holds them."""
        evidence = gather(folder)
        self._rewrite_journal(evidence)
        self._journal = Journal(folder / JOURNAL_NAME, now_ns())
        try:
            self._add_lines(evidence)
            self._state = replay(folder / JOURNAL_NAME)
            self._header = read_header(folder, self._state)
        except BaseException:
            self._journal.close()
            raise
        self._final_sound = final_is_sound(folder, self._state)

    def run(self) -> Report:
        """Configuration, merged file, steps; a merged file that could not be repaired alone is merged again."""
        try:
            self._snapshots()
            closed = self._state.closed is not None
            if closed and not self._final_sound:
                self._final_alone()
            for line in list(self._state.segments):
                self._segment(line)
            if closed and not self._final_sound:
                self._merge_again()
        finally:
            self._journal.close()
        self._report.lost += self._lost_steps
        counts = (self._state.closed or {}).get("counts", counts_of(self._state))
        self._report.strokes = counts.get(Topic.STROKE, 0)
        return self._report

    def _rewrite_journal(self, evidence: Evidence) -> None:
        """A journal that cannot be read is written again from what is intact and what the files tell."""
        if evidence.intact:
            return
        path = self._folder / JOURNAL_NAME
        kept = set_aside(path, "damaged").name if path.exists() else ""
        fresh = path.with_name(path.name + ".repair")
        with fresh.open("wb") as file:
            for line in evidence.all_lines:
                file.write(_encoded(line))
            lost = len(evidence.spoilt)
            words = {"event": "journal", "aside": kept, "rebuilt": len(evidence.rebuilt), "lost": lost}
            file.write(encode_line(self._now_ns(), words))
            file.flush()
            os.fsync(file.fileno())
        fresh.replace(path)
        fsync_folder(self._folder)
        self._report.did.append(
            f"wrote {JOURNAL_NAME} again: {len(evidence.lines)} lines as they were, {len(evidence.rebuilt)} rebuilt "
            f"from the files{f'; the damaged one is kept as {kept}' if kept else ''}"
        )
        if lost:
            self._report.lost.append(f"{lost} lines of {JOURNAL_NAME} that no file tells")

    def _add_lines(self, evidence: Evidence) -> None:
        if evidence.intact:
            for line in evidence.rebuilt:
                self._journal.append(int(line["t_ns"]), _without_time(line))
                what = step_words(line) if line["event"] != "closed" else "the session"
                self._report.did.append(f"journalled {line['event']!r} of {what}, which {_file(line)} shows")
        sheet = evidence.state.sheet
        if evidence.doubtful and sheet not in evidence.state.doubtful_sheets:
            for name in evidence.doubtful:
                self._journal.append(self._now_ns(), {"event": "doubt", "file": name, "sheet": sheet})
                self._report.lost.append(
                    f"which cell {name} pressed: nothing more is pressed on sheet {sheet + 1}; "
                    f"go on with a fresh one, --sheet {sheet + 2}"
                )

    def _snapshots(self) -> None:
        for name, text in (self._state.opened or {}).get("snapshots", {}).items():
            path = self._folder / Path(str(name)).name
            data = str(text).encode()
            if path.is_file() and path.read_bytes() == data:
                continue
            kept = set_aside(path, "damaged").name if path.is_file() else ""
            fresh = path.with_name(path.name + ".repair")
            with fresh.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            fresh.replace(path)
            fsync_folder(self._folder)
            self._report.did.append(f"wrote {path.name} again from the journal{kept_words(kept)}")

    def _segment(self, line: Line) -> None:
        path = self._folder / str(line["file"])
        held = "held" in line
        if held and self._final_sound:
            return
        try:
            verify(path, str(line["sha256"]))
        except SessionDamaged as error:
            if not held or path.exists():
                self._damaged(path, line, error.what)
            elif not path.exists():
                self._lose(path, line, "only the merged file held it, and that is damaged")

    def _damaged(self, path: Path, line: Line, why: str) -> None:
        step = step_words(line)
        found = scan(path) if path.is_file() else Scan(path)
        why = "; ".join(found.damage) or why
        counts = Counter[str](line["counts"])
        ours = _is_ours(found, line) and not found.counts - counts
        missing = counts - found.counts if ours else counts
        if missing and self._final_sound:
            kept = self._move_aside(path)
            self._log({"event": "held", "key": line["key"], "file": path.name, "by": self._final.name, "why": why})
            self._report.did.append(f"{path.name} ({step}) {why}: the merged file holds all of it{kept_words(kept)}")
        elif any(topic in missing for topic in _needed(counts)):
            self._lose(path, line, why)
        else:
            self._write_again(path, line, found if ours else Scan(path), dict(missing), why)

    def _write_again(self, path: Path, line: Line, found: Scan, missing: dict[str, int], why: str) -> None:
        begin = {"t_ns": line["t_ns"], "header": self._header.model_dump(mode="json"), "line": self._begin_of(line)}
        fields = ("key", "kind", "attempt", "result", "counts", "t_ns")
        notes = {
            BEGIN_NOTE: found.notes.get(BEGIN_NOTE, begin),
            DONE_NOTE: {name: line[name] for name in fields} | {"counts": dict(found.counts)},
        }
        kept, counts = replace_damaged(path, self._header, notes, {}, salvaged(found))
        event: Line = {"event": "repaired", "key": line["key"], "file": path.name, "sha256": file_sha256(path)}
        self._log({**event, "counts": counts, "missing": missing, "aside": kept, "why": why})
        words = ", ".join(f"{count} of {topic}" for topic, count in missing.items())
        how = f"without {words}" if words else "whole"
        self._report.did.append(f"wrote {path.name} ({step_words(line)}) again {how}: {why}{kept_words(kept)}")
        if words:
            self._lost_steps.append(f"messages in {path.name} ({step_words(line)}): {words}")

    def _begin_of(self, line: Line) -> Line:
        """The attempt's `begin` line as the journal has it; what `done` knows of it where it has none."""
        known = {"event": "begin", "key": line["key"], "kind": line["kind"], "attempt": line.get("attempt", 1)}
        return {**known, "sheet": line["result"].get("sheet", self._state.sheet), "cell": None, "file": line["file"]}

    def _lose(self, path: Path, line: Line, why: str) -> None:
        kept = self._move_aside(path)
        again = "" if self._state.closed is not None else "; it is done again when the session goes on"
        self._log({"event": "lost", "key": line["key"], "file": path.name, "aside": kept, "why": why})
        self._report.did.append(f"marked {path.name} ({step_words(line)}) as lost: {why}{kept_words(kept)}")
        self._lost_steps.append(f"{step_words(line)}{again}")
        if self._state.closed is None:
            self._lose_its_press(line)

    def _lose_its_press(self, line: Line) -> None:
        """A photograph can be taken again only while its sheet is in: else the stroke must be pressed again."""
        stroke = line["result"].get("stroke_id")
        for other in list(self._state.segments):
            result = other["result"]
            if stroke is None or result.get("stroke_id") != stroke or "sheet" not in result:
                continue
            if result["sheet"] != self._state.sheet:
                why = f"its photograph is lost and its sheet {int(result['sheet']) + 1} is no longer in"
                event = {"event": "lost", "key": other["key"], "file": other["file"], "aside": "", "why": why}
                self._log(event)
                self._report.did.append(f"marked {other['file']} ({step_words(other)}) as lost: {why}")

    def _move_aside(self, path: Path) -> str:
        if not path.exists():
            return ""
        kept = set_aside(path, "damaged")
        path.unlink()
        fsync_folder(self._folder)
        return kept.name

    def _final_alone(self) -> None:
        """Where every message of the merged file can be read, it is written again from itself."""
        found = scan(self._final) if self._final.is_file() else Scan(self._final)
        if dict(found.counts) == (self._state.closed or {}).get("counts", {}):
            self._rewrite_final(found)
            self._final_sound = True

    def _merge_again(self) -> None:
        """From the steps' files, or from what can be read of the merged file where that holds more strokes."""
        found = scan(self._final) if self._final.is_file() else Scan(self._final)
        if found.counts[Topic.STROKE] > counts_of(self._state).get(Topic.STROKE, 0):
            self._lost_steps = self._rewrite_final(found)
            return
        why = "; ".join(found.damage) or ("has changed" if self._final.is_file() else "is missing")
        kept = set_aside(self._final, "damaged").name if self._final.is_file() else ""
        merge_session(self._folder, self._state, self._header, "damaged")
        self._log(closed_line(self._final, counts_of(self._state)))
        self._report.did.append(f"merged {self._final.name} again from the steps' files: it {why}{kept_words(kept)}")

    def _rewrite_final(self, found: Scan) -> list[str]:
        """Returns what was lost, in words."""
        messages, strokes = with_their_stills(found)
        names = (self._state.opened or {}).get("snapshots", {})
        files = {a.name: a.data for a in found.attachments} | {str(k): str(v).encode() for k, v in names.items()}
        notes: dict[str, Line] = {REPAIRS_NOTE: {"repairs": self._state.repairs}} if self._state.repairs else {}
        kept, counts = replace_damaged(self._final, self._header, notes, files, messages)
        before = (self._state.closed or {}).get("counts", {})
        self._log(closed_line(self._final, counts))
        why = "; ".join(found.damage) or "has changed"
        self._report.did.append(f"wrote {self._final.name} again from what can be read of it: {why}{kept_words(kept)}")
        gone = {topic: count - counts.get(topic, 0) for topic, count in before.items()}
        lost = [f"stroke {name}: its photograph is lost" for name in strokes]
        return lost + [f"messages on {topic}: {count}" for topic, count in gone.items() if count > 0]

    def _log(self, line: Line) -> None:
        t_ns = self._now_ns()
        self._journal.append(t_ns, line)
        fold(self._state, {"t_ns": t_ns, **line})


def _needed(counts: Counter[str]) -> tuple[str, ...]:
    """A photograph that is no stroke's (the board) is found by the event of its step."""
    return MEASURED if counts[Topic.STROKE] or not counts[Topic.STILL] else (*MEASURED, str(Topic.STEP))


def _is_ours(found: Scan, line: Line) -> bool:
    """Whether a damaged file shows that it is this attempt's: readable does not mean that it belongs here."""
    identity = (line["key"], line.get("attempt"))
    begin = found.notes.get(BEGIN_NOTE, {}).get("line", {})
    done = found.notes.get(DONE_NOTE, {})
    if identity in ((begin.get("key"), begin.get("attempt")), (done.get("key"), done.get("attempt"))):
        return True
    for _schema, channel, message in salvaged(found):
        if channel.topic == Topic.STEP:
            try:
                event = StepEvent.model_validate_json(message.data)
            except ValidationError:
                return False
            return (event.key, event.attempt) == identity
    return False


def _encoded(line: Line) -> bytes:
    return encode_line(int(line.get("t_ns", 0)), _without_time(line))


def _without_time(line: Line) -> Line:
    return {name: value for name, value in line.items() if name != "t_ns"}


def _file(line: Line) -> str:
    return str(line.get("file", "the header"))


def kept_words(name: str) -> str:
    """Where the damaged file went."""
    return f"; the damaged file is kept as {name}" if name else ""
