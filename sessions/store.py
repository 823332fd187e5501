"""A session's folder: made, locked, resumed, closed. The engine writes through this and through nothing else."""

from __future__ import annotations

import datetime as dt
import difflib
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from pydantic import ValidationError

from sessions.errors import InputError, SessionDamaged, SessionError, SessionLocked, in_one_line
from sessions.journal import JOURNAL_NAME, Journal, Line, Replay, fsync_folder, is_open, replay
from sessions.merge import merge, verify
from sessions.schemas import Header, Recorded
from sessions.writer import SegmentWriter

SESSION_ID = re.compile(r"[0-9A-Za-z][0-9A-Za-z._-]{0,99}")
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
    """One session open for writing, under its lock. Raises `InputError` where there is none to go on with."""

    def __init__(self, folder: Path, header: Header | None, now_ns: Callable[[], int]) -> None:
        self.folder = folder
        self._now_ns = now_ns
        if header is None and not (folder / JOURNAL_NAME).is_file():
            raise InputError(folder, f"holds no {JOURNAL_NAME}: not a session that was collected")
        # One lock for all threads: the engine opens the store in one and may release it in another.
        self._lock = FileLock(folder / ".lock", timeout=0, thread_local=False)
        try:
            self._lock.acquire()
        except Timeout:
            raise SessionLocked(folder, "another brushloop is collecting into this session") from None
        except OSError as error:
            raise SessionError(folder, f"cannot lock: {in_one_line(error)}") from error
        self._journal: Journal | None = None
        try:
            if header is None and replay(folder / JOURNAL_NAME).closed is not None:
                raise InputError(folder, "is closed; a finished recording is never changed")
            self._journal = Journal(folder / JOURNAL_NAME, now_ns())
            if header is not None:
                self._log({"event": "open", "header": header.model_dump(mode="json")})
            self.state: Replay = replay(folder / JOURNAL_NAME)
            self.header = _header(folder, self.state)
            self._log({"event": "process"})
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
            raise SessionError(folder, f"cannot create: {in_one_line(error)}") from error
        return cls(folder, header, now_ns)

    def begin(self, key: str, kind: str, *, cell: int | None, notes: Line) -> Attempt:
        """Journal that an attempt starts, then open its file."""
        attempt = self.state.attempts.get(key, 0) + 1
        serial = self.state.begun
        name = f"{serial:04d}-{kind}-{key[:8]}.mcap"
        self._log(
            {
                "event": "begin",
                "key": key,
                "kind": kind,
                "attempt": attempt,
                "sheet": self.state.sheet,
                "cell": cell,
                "file": name,
                **notes,
            }
        )
        self.state.attempts[key] = attempt
        self.state.begun += 1
        if cell is not None:
            self.state.used_cells.add((self.state.sheet, cell))
        return Attempt(key, kind, serial, attempt, SegmentWriter(self.folder / name, self.header), cell)

    def done(self, attempt: Attempt, result: dict[str, Any]) -> None:
        """Finish the file, then journal `done`: from here on the step is never done again."""
        recorded: Recorded = attempt.writer.finish()
        line: Line = {
            "event": "done",
            "key": attempt.key,
            "kind": attempt.kind,
            "attempt": attempt.attempt,
            "file": attempt.writer.final.name,
            "sha256": recorded.sha256,
            "counts": recorded.counts,
            "result": result,
        }
        self._log(line)
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
        for line in self.state.segments:
            verify(self.folder / str(line["file"]), str(line["sha256"]))

    def close(self) -> Path:
        """Verify every segment, merge, read back, journal `closed`. Returns the merged file."""
        self.verify()
        final = self.folder / f"{self.folder.name}.mcap"
        files = [self.folder / str(line["file"]) for line in self.state.segments]
        snapshots = [path for name in SNAPSHOT_NAMES if (path := self.folder / name).is_file()]
        counts: Counter[str] = Counter()
        for line in self.state.segments:
            counts.update(line["counts"])
        merge(files, final, self.header, snapshots, dict(counts))
        self._log({"event": "closed", "file": final.name, "counts": counts})
        return final

    def release(self) -> None:
        """Give the lock back; the session can be resumed or read by anyone."""
        try:
            if self._journal is not None:
                self._journal.close()
        finally:
            self._journal = None
            self._lock.release()

    def _log(self, line: Line) -> None:
        assert self._journal is not None, "the store was released"
        self._journal.append(self._now_ns(), line)


def _header(folder: Path, state: Replay) -> Header:
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
    return [folder for folder in folders if is_open(replay(folder / JOURNAL_NAME))]


def differences(folder: Path, snapshots: Snapshots) -> str:
    """A unified diff from the session's configuration to the given one; empty where they are the same."""
    lines: list[str] = []
    for name, text in snapshots.items():
        stored = (folder / name).read_text(encoding="utf-8") if (folder / name).exists() else ""
        lines += difflib.unified_diff(
            stored.splitlines(), text.splitlines(), f"session/{name}", f"now/{name}", lineterm="", n=0
        )
    return "\n".join(lines)
