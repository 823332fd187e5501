"""The repair of a session's folder: journal first, then configuration, steps, and the merged file.

A step is put together again from every file that still holds some of it: its own, the merged file, and files that
have another's name. The merged file is merged again from the steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

from sessions.disk import set_aside
from sessions.errors import SessionDamaged
from sessions.journal.codec import Line
from sessions.journal.journal import JOURNAL_NAME, fold, fsync_folder, replay
from sessions.merge import REPAIRS_NOTE, verify
from sessions.recording.salvage import Scan, scan
from sessions.recording.schemas import Topic
from sessions.recording.writer import BEGIN_NOTE, DONE_NOTE, file_sha256
from sessions.repair.evidence import final_is_sound, gather
from sessions.repair.journal import Report, kept_words, repaired_journal, write_anew
from sessions.repair.rewrite import lost_words, replace_damaged, with_their_stills
from sessions.repair.soundness import file_problems
from sessions.repair.union import Record, Source, identity_of, united
from sessions.store import closed_line, counts_of, merge_session, read_header
from sessions.verify import step_words

MEASURED = (str(Topic.STILL), str(Topic.STROKE))
"""Without these a step is worth nothing and is done again; a gap in anything else is told and kept."""


class FolderRepair:
    """One repair of one folder, its lock held."""

    def __init__(self, folder: Path, now_ns: Callable[[], int]) -> None:
        self._folder = folder
        self._final = folder / f"{folder.name}.mcap"
        self._now_ns = now_ns
        self._report = Report(folder.name)
        self._lost_steps: list[str] = []
        """Told as lost unless the merged file holds them."""
        self._scans: dict[tuple[int, int, int], tuple[Scan, tuple[str, int] | None]] = {}
        """Of each file that was looked at, by its inode, size and time: what it holds, and whose it is."""
        evidence = gather(folder)
        self._strays = evidence.strays
        self._begins = [told for told in evidence.all_lines if told["event"] == "begin"]
        self._header = read_header(folder, evidence.state)
        self._journal = repaired_journal(evidence, self._header.session_id, now_ns, self._report)
        try:
            self._state = replay(folder / JOURNAL_NAME)
            self._final_sound = final_is_sound(folder, self._state)
            self._totals = Counter[str](counts_of(self._state))
            self._merged = self._steps_of_merged()
        except BaseException:
            self._journal.close()
            raise

    def run(self) -> Report:
        """Configuration, steps, merged file."""
        try:
            self._snapshots()
            for line in list(self._state.segments):
                self._segment(line)
            for name in self._strays:
                kept = self._move_aside(self._folder / name)
                self._report.did.append(f"put {name} aside: it is a copy of another step{kept_words(kept)}")
            if self._state.closed is None:
                self._left_by_a_close()
            elif not self._final_sound:
                self._merge_again()
        finally:
            self._journal.close()
        self._report.lost += self._lost_steps
        counts = (self._state.closed or {}).get("counts", counts_of(self._state))
        self._report.strokes = counts.get(Topic.STROKE, 0)
        return self._report

    def _steps_of_merged(self) -> dict[str, Counter[str]]:
        """File of a step -> messages by topic that precede it in the merged file; empty where nobody can tell."""
        before: dict[str, Counter[str]] = {}
        number = Counter[str]()
        for line in self._state.segments:
            before[line["file"]] = number.copy()
            number.update(line["counts"])
        closed = self._state.closed or {}
        return before if closed.get("counts", self._totals) == self._totals else {}

    def _snapshots(self) -> None:
        for name, text in (self._state.opened or {}).get("snapshots", {}).items():
            path = self._folder / name
            data = text.encode()
            if not path.is_file() or path.read_bytes() != data:
                kept = write_anew(path, data)
                self._report.did.append(f"wrote {path.name} again from the journal{kept_words(kept)}")

    def _segment(self, line: Line) -> None:
        path = self._folder / line["file"]
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
        found = self._look(path)[0] if path.is_file() else Scan(path)
        why = "; ".join(found.damage) or why
        counts = Counter[str](line["counts"])
        records = united(line, self._sources(path, line, counts))
        missing = counts - Counter(channel.topic for _schema, channel, _message in records)
        if missing and self._final_sound:
            kept = self._move_aside(path)
            self._log({"event": "held", "key": line["key"], "file": path.name, "by": self._final.name, "why": why})
            self._report.did.append(f"{path.name} ({step}) {why}: the merged file holds all of it{kept_words(kept)}")
        elif any(topic in missing for topic in _needed(counts)):
            self._lose(path, line, why)
        else:
            self._write_again(path, line, found, records, dict(missing), why)

    def _sources(self, path: Path, line: Line, counts: Counter[str]) -> Iterator[Source]:
        """Where messages of the step may be: its own file, the merged file, and any that says it is this step's."""
        identity, nothing = (line["key"], line.get("attempt", 1)), Counter[str]()
        others = (other for other in sorted(self._folder.glob("*.mcap*")) if other not in (path, self._final))
        for place in (path, self._final, *others):
            if not place.is_file():
                continue
            if place != self._final:
                found, whose = self._look(place)
                if whose == identity:
                    yield Source(found, counts, nothing)
            elif path.name in self._merged:
                yield Source(self._look(place)[0], self._totals, self._merged[path.name])

    def _look(self, path: Path) -> tuple[Scan, tuple[str, int] | None]:
        """What a file holds, and whose it is; read only once, whatever name it is given meanwhile."""
        told = path.stat()
        known = (told.st_ino, told.st_size, told.st_mtime_ns)
        if known not in self._scans:
            found = scan(path)
            self._scans[known] = found, None if path == self._final else identity_of(found)
        self._scans[known][0].path = path
        return self._scans[known]

    def _write_again(
        self, path: Path, line: Line, found: Scan, records: list[Record], missing: dict[str, int], why: str
    ) -> None:
        begin = {"t_ns": line["t_ns"], "header": self._header.model_dump(mode="json"), "line": self._begin_of(line)}
        if self._look(path)[1] == (line["key"], line.get("attempt", 1)) if path.is_file() else False:
            begin = found.notes.get(BEGIN_NOTE, begin)
        counts = dict(Counter(channel.topic for _schema, channel, _message in records))
        done = {name: line[name] for name in ("key", "kind", "result", "t_ns")}
        notes = {BEGIN_NOTE: begin, DONE_NOTE: {**done, "attempt": line.get("attempt", 1), "counts": counts}}
        kept, counts = replace_damaged(path, self._header, notes, {}, records)
        event: Line = {"event": "repaired", "key": line["key"], "file": path.name, "sha256": file_sha256(path)}
        self._log({**event, "counts": counts, "missing": missing, "aside": kept, "why": why})
        words = ", ".join(f"{count} of {topic}" for topic, count in missing.items())
        how = f"without {words}" if words else "whole"
        self._report.did.append(f"wrote {path.name} ({step_words(line)}) again {how}: {why}{kept_words(kept)}")
        if words:
            self._lost_steps.append(f"messages in {path.name} ({step_words(line)}): {words}")

    def _begin_of(self, line: Line) -> Line:
        """The attempt's `begin` line as the journal has it; what `done` knows of it where it has none."""
        for told in self._begins:
            if told["file"] == line["file"]:
                return {name: value for name, value in told.items() if name != "t_ns"}
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

    def _merge_again(self) -> None:
        """From the steps' files, or from what can be read of the merged file where that holds more strokes."""
        found = self._look(self._final)[0] if self._final.is_file() else Scan(self._final)
        if not self._merged and len(with_their_stills(found).kept) > counts_of(self._state).get(Topic.STROKE, 0):
            self._lost_steps = self._rewrite_final(found)
            return
        why = "; ".join(found.damage) or ("has changed" if self._final.is_file() else "is missing")
        kept = set_aside(self._final, "damaged").name if self._final.is_file() else ""
        merge_session(self._folder, self._state, self._header, "damaged")
        self._log(closed_line(self._final, counts_of(self._state)))
        self._report.did.append(f"merged {self._final.name} again from the steps' files: it {why}{kept_words(kept)}")

    def _rewrite_final(self, found: Scan) -> list[str]:
        """Returns what was lost, in words."""
        strokes = with_their_stills(found)
        names = (self._state.opened or {}).get("snapshots", {})
        files = {a.name: a.data for a in found.attachments} | {name: text.encode() for name, text in names.items()}
        notes: dict[str, Line] = {REPAIRS_NOTE: {"repairs": self._state.repairs}} if self._state.repairs else {}
        kept, counts = replace_damaged(self._final, self._header, notes, files, strokes.messages())
        before = Counter[str]((self._state.closed or {}).get("counts", {}))
        self._log(closed_line(self._final, counts))
        why = "; ".join(found.damage) or "has changed"
        self._report.did.append(f"wrote {self._final.name} again from what can be read of it: {why}{kept_words(kept)}")
        return lost_words(strokes, before, counts)

    def _left_by_a_close(self) -> None:
        """A merged file of a session that is open: it is merged again in any case."""
        problems = file_problems(self._final)[1] if self._final.is_file() else []
        if problems:
            kept = self._move_aside(self._final)
            self._report.did.append(
                f"put {self._final.name} aside, which no close was journalled for{kept_words(kept)}"
            )

    def _log(self, line: Line) -> None:
        t_ns = self._now_ns()
        self._journal.append(t_ns, line)
        fold(self._state, {"t_ns": t_ns, **line})


def _needed(counts: Counter[str]) -> tuple[str, ...]:
    """A photograph that is no stroke's (the board) is found by the event of its step."""
    return MEASURED if counts[Topic.STROKE] or not counts[Topic.STILL] else (*MEASURED, str(Topic.STEP))
