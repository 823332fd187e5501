"""A session's folder: made, locked, resumed, closed. The engine writes through this and through nothing else."""

from __future__ import annotations

import datetime as dt
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pydantic import ValidationError

from sessions.disk import check_room, free_bytes, set_aside
from sessions.errors import InputError, SessionDamaged, SessionError, SessionLocked, disk_error, in_one_line
from sessions.journal.codec import Line
from sessions.journal.journal import JOURNAL_NAME, Journal, Replay, fsync_folder, is_open, replay
from sessions.merge import merge, verify
from sessions.names import check_folder
from sessions.recording.schemas import Header, Recorded
from sessions.recording.writer import QUEUE_LIMIT, SegmentWriter, file_sha256

STEP_BYTES = 64 * 1024 * 1024
"""Room that the disk must have before a step begins: more than the photographs and poses of any one step."""
SESSION_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,99}")
SEGMENT_NAME = re.compile(r"(\d{4,})-([a-z_]+)-([0-9A-Za-z_.-]+?)\.mcap(\.part)?")
"""Serial, kind, start of the key, and `.part` while unfinished."""
SNAPSHOT_NAMES = ("rig.toml", "protocol.toml", "rig.effective.json")
Snapshots = dict[str, str]
"""File name -> text of the configuration that a session was started with."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a step, with its file open."""

    key: str
    kind: str
    serial: int
    """Unique in the session."""
    attempt: int
    writer: SegmentWriter
    cell: int | None


class SessionStore:
    """One session open for writing, under its lock. Raises `InputError` where there is none to go on with.

    `snapshots` are the texts of the configuration, for a new session: the journal keeps them as well. A session
    that is damaged raises `SessionDamaged`, with `brushloop sessions repair` as the way out.
    """

    def __init__(
        self, folder: Path, header: Header | None, now_ns: Callable[[], int], snapshots: Snapshots | None = None
    ) -> None:
        self.folder = folder
        self._now_ns = now_ns
        if header is None:
            if not (folder / JOURNAL_NAME).is_file():
                raise InputError(folder, f"holds no {JOURNAL_NAME}: not a session that was collected")
            check_folder(folder)
        self._lock = lock(folder)
        self._journal: Journal | None = None
        try:
            self.state = Replay() if header is not None else replay(folder / JOURNAL_NAME)
            if self.state.closed is not None:
                raise InputError(folder, "is closed; a finished recording is never changed")
            self.header = header or read_header(folder, self.state)
            self._journal = Journal(folder / JOURNAL_NAME, now_ns(), self.header.session_id)
            if header is not None:
                self._log(open_line(header, snapshots or {}))
                self.state = replay(folder / JOURNAL_NAME)
            self._check_serials()
            self._log({"event": "process"})
        except SessionDamaged as error:
            error.add_note(f"Try `brushloop sessions repair {folder}`.")
            self.release()
            raise
        except BaseException:
            self.release()
            raise

    @classmethod
    def create(cls, folder: Path, header: Header, snapshots: Snapshots, now_ns: Callable[[], int]) -> SessionStore:
        """Make a new session folder. Raises `InputError` where it exists."""
        try:
            folder.mkdir(parents=True)
            for name, text in snapshots.items():
                _write_durably(folder / name, text)
            fsync_folder(folder.parent)
        except FileExistsError:
            raise InputError(folder, "exists already; recordings are never overwritten") from None
        except OSError as error:
            raise disk_error(folder, "cannot create", error) from error
        return cls(folder, header, now_ns, snapshots)

    def free_bytes(self) -> int:
        """Room left on the session's disk. Raises `SessionError`."""
        return free_bytes(self.folder)

    def check_room(self, need_bytes: int = STEP_BYTES) -> None:
        """Raise `DiskFull` unless the disk has that much room. `begin` asks by itself, before it journals anything."""
        check_room(self.folder, need_bytes)

    def begin(self, key: str, kind: str, *, cell: int | None, notes: Line) -> Attempt:
        """Journal that an attempt starts, then open its file.

        Raises `DiskFull`, or `SessionError` for a press on a sheet that may hold one that nobody knows of; nothing
        has happened then.
        """
        self.check_room()
        if cell is not None and self.state.sheet in self.state.doubtful_sheets:
            sheet = self.state.sheet + 1
            raise SessionError(
                self.folder,
                f"the record of a press on sheet {sheet} was lost, so a cell may hold ink that nobody knows of. "
                f"Put a fresh sheet in, then run the same command with --sheet {sheet + 1}",
            )
        attempt = self.state.attempts.get(key, 0) + 1
        serial = self.state.begun
        name = f"{serial:04d}-{kind}-{key[:8]}.mcap"
        line: Line = {
            "event": "begin",
            "key": key,
            "kind": kind,
            "attempt": attempt,
            "sheet": self.state.sheet,
            "cell": cell,
            "file": name,
            **notes,
        }
        t_ns = self._log(line)
        self.state.attempts[key] = attempt
        self.state.begun += 1
        if cell is not None:
            self.state.used_cells |= {(self.state.sheet, one) for one in (cell, *notes.get("more_cells", ()))}
        begun = {"t_ns": t_ns, "header": self.header.model_dump(mode="json"), "line": line}
        writer = SegmentWriter(self.folder / name, self.header, QUEUE_LIMIT, begun)
        return Attempt(key, kind, serial, attempt, writer, cell)

    def done(self, attempt: Attempt, result: dict[str, Any]) -> None:
        """Finish the file, then journal `done`: from here on the step is never done again."""
        t_ns = self._now_ns()
        identity = {"key": attempt.key, "kind": attempt.kind, "attempt": attempt.attempt}
        file = attempt.writer.final.name
        recorded = attempt.writer.finish({"t_ns": t_ns, **identity, "result": result})
        line = done_line(identity, file, recorded, result)
        self._log(line, t_ns)
        self.state.done[attempt.key] = line
        self.state.segments.append(line)

    def void(self, attempt: Attempt, why: str) -> None:
        """Journal that an attempt was cut; its part file stays as evidence, its cell stays used."""
        attempt.writer.abandon()
        self._log({"event": "void", "key": attempt.key, "attempt": attempt.attempt, "why": why})
        self.state.voids += 1

    def fresh_sheet(self) -> None:
        """Journal that the operator put a fresh sheet in: its cells are all free."""
        self.state.sheet += 1
        self._log({"event": "sheet", "sheet": self.state.sheet})

    def verify(self) -> None:
        """Raise `SessionDamaged` naming the first finished step whose file is missing or has changed."""
        try:
            for line in self.state.segments:
                verify(self.folder / str(line["file"]), str(line["sha256"]))
        except SessionDamaged as error:
            error.add_note(f"Try `brushloop sessions repair {self.folder}`.")
            raise

    def close(self) -> Path:
        """Verify every segment, merge, read back, journal `closed`. Returns the merged file.

        Raises `SessionDamaged`, or `DiskFull` before anything is written; the session then stays open.
        """
        self.verify()
        self.check_room(sum((self.folder / str(line["file"])).stat().st_size for line in self.state.segments))
        final = merge_session(self.folder, self.state, self.header)
        self._log(closed_line(final, counts_of(self.state)))
        return final

    def release(self) -> None:
        """Give the lock back; the session can be resumed or read by anyone."""
        try:
            if self._journal is not None:
                self._journal.close()
        finally:
            self._journal = None
            self._lock.release()

    def _log(self, line: Line, t_ns: int | None = None) -> int:
        assert self._journal is not None, "the store was released"
        t_ns = self._now_ns() if t_ns is None else t_ns
        if t_ns < self.state.last_ns:
            self._journal.append(t_ns, {"event": "clock", "back_s": (self.state.last_ns - t_ns) / 1e9})
        self.state.last_ns = t_ns
        self._journal.append(t_ns, line)
        return t_ns

    def _check_serials(self) -> None:
        """A journal that lost its last lines would give their numbers, and their cells, away again."""
        for path in sorted(self.folder.glob("*.mcap*")):
            serial = SEGMENT_NAME.fullmatch(path.name)
            if serial and int(serial[1]) >= self.state.begun:
                raise SessionDamaged(self.folder / JOURNAL_NAME, f"says nothing of {path.name}: lines are missing")


def lock(folder: Path) -> FileLock:
    """The session's lock, taken. Raises `SessionLocked` while another process has it."""
    # One lock for all threads: the engine opens the store in one and may release it in another.
    held = FileLock(folder / ".lock", timeout=0, thread_local=False)
    try:
        held.acquire()
    except Timeout:
        raise SessionLocked(folder, "another brushloop has this session open") from None
    except OSError as error:
        raise disk_error(folder, "cannot lock", error) from error
    return held


def open_line(header: Header, snapshots: Snapshots) -> Line:
    """The journal's first event."""
    return {"event": "open", "header": header.model_dump(mode="json"), "snapshots": snapshots}


def done_line(identity: Line, file: str, recorded: Recorded, result: Line) -> Line:
    """The event of a finished step."""
    counts = dict(recorded.counts)
    return {"event": "done", **identity, "file": file, "sha256": recorded.sha256, "counts": counts, "result": result}


def closed_line(final: Path, counts: dict[str, int]) -> Line:
    """The event of a closed session."""
    return {"event": "closed", "file": final.name, "sha256": file_sha256(final), "counts": counts}


def counts_of(state: Replay) -> dict[str, int]:
    """Messages by topic that the merged file must hold."""
    counts: Counter[str] = Counter()
    for line in state.segments:
        counts.update(line["counts"])
    return dict(counts)


def merge_session(folder: Path, state: Replay, header: Header, tag: str = "superseded") -> Path:
    """Write and read back the merged file. One that is there already, from a close that was cut, is kept beside."""
    final = folder / f"{folder.name}.mcap"
    files = [folder / str(line["file"]) for line in state.segments]
    snapshots = [path for name in SNAPSHOT_NAMES if (path := folder / name).is_file()]
    if final.exists():
        set_aside(final, tag)
    merge(files, final, header, snapshots, counts_of(state), state.repairs)
    return final


def read_header(folder: Path, state: Replay) -> Header:
    """The header in the journal. Raises `SessionDamaged`."""
    if state.opened is None:
        raise SessionDamaged(folder / JOURNAL_NAME, "has no `open` event")
    try:
        return Header.model_validate(state.opened["header"])
    except (KeyError, ValidationError) as error:
        raise SessionDamaged(folder / JOURNAL_NAME, f"its `open` event has no header: {in_one_line(error)}") from None


def _write_durably(path: Path, text: str) -> None:
    with path.open("x", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def next_session_id(root: Path, label: str, today: dt.date) -> str:
    """`2026-11-21-grid-01`: the first number that is free under `root`."""
    for number in range(1, 1000):
        session_id = f"{today.isoformat()}-{label}-{number:02d}"
        if not (root / session_id).exists():
            return session_id
    raise InputError(root, f"has 999 sessions of {today.isoformat()}-{label}")


def open_sessions(root: Path) -> list[Path]:
    """Folders under `root` whose journal was opened and has no `closed` event, oldest first."""
    folders = sorted(path.parent for path in root.glob(f"*/{JOURNAL_NAME}"))
    for folder in folders:
        check_folder(folder)
    return [folder for folder in folders if is_open(replay(folder / JOURNAL_NAME))]
