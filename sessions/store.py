"""A session's folder open for writing: created, locked, resumed, closed. The engine writes only through this."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from brushloop.sessions.disk import check_digest, check_room, file_sha256, free_bytes, fsync_folder, write_durably
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, SessionLocked, disk_error
from brushloop.sessions.journal import JOURNAL_NAME, Journal, Line
from brushloop.sessions.journal.journal import Replay, read_header, replay
from brushloop.sessions.names import SEGMENT_NAME, check_folder
from brushloop.sessions.recording import merge_session
from brushloop.sessions.records import Header, Recorded
from brushloop.sessions.step_file import QUEUE_LIMIT, SegmentWriter

STEP_BYTES = 64 * 1024 * 1024
"""Room needed on the disk before a step begins: more than the photographs and poses of any one step."""
Snapshots = dict[str, str]
"""File name -> text of the configuration that a session was started with."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a step, with its file open."""

    key: str
    kind: str
    serial: int
    """Number of the attempt, unique in the session."""
    attempt: int
    writer: SegmentWriter
    patch: int | None


class SessionStore:
    """One session open for writing, under its lock; without a header, an existing one is resumed.

    A new session needs a header and `snapshots`, the texts of its configuration, which the journal keeps as well.
    Raises `InputError` if no session can be resumed, and `SessionDamaged` (its note names `brushloop sessions repair`).
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
                write_durably(folder / name, text.encode())
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
        """Raise `DiskFull` unless the disk has that much room. `begin` checks this before it journals anything."""
        check_room(self.folder, need_bytes)

    def begin(self, key: str, kind: str, *, patch: int | None, notes: Line) -> Attempt:
        """Journal that an attempt starts, then open its file.

        Raises `DiskFull`, or `SessionError` for a press on a sheet that may hold an unrecorded one, before anything
        is written.
        """
        self.check_room()
        if patch is not None and self.state.sheet in self.state.doubtful_sheets:
            sheet = self.state.sheet + 1
            raise SessionError(
                self.folder,
                f"the record of a press on sheet {sheet} was lost, so any of its patches may already hold ink. "
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
            "patch": patch,
            "file": name,
            **notes,
        }
        t_ns = self._log(line)
        self.state.attempts[key] = attempt
        self.state.begun += 1
        if patch is not None:
            self.state.used_patches |= {(self.state.sheet, one) for one in (patch, *notes.get("more_patches", ()))}
        begun = {"t_ns": t_ns, "header": self.header.model_dump(mode="json"), "line": line}
        writer = SegmentWriter(self.folder / name, self.header, QUEUE_LIMIT, begun)
        return Attempt(key, kind, serial, attempt, writer, patch)

    def done(self, attempt: Attempt, result: dict[str, Any]) -> None:
        """Finish the file, then journal `done`: after this the step is never done again."""
        t_ns = self._now_ns()
        identity = {"key": attempt.key, "kind": attempt.kind, "attempt": attempt.attempt}
        file = attempt.writer.final.name
        recorded = attempt.writer.finish({"t_ns": t_ns, **identity, "result": result})
        line = done_line(identity, file, recorded, result)
        self._log(line, t_ns)
        self.state.done[attempt.key] = line
        self.state.segments.append(line)

    def void(self, attempt: Attempt, why: str) -> None:
        """Journal that an attempt was cut; its part file is kept as evidence, and its patch stays used."""
        attempt.writer.abandon()
        self._log({"event": "void", "key": attempt.key, "attempt": attempt.attempt, "why": why})
        self.state.voids += 1

    def fresh_sheet(self) -> None:
        """Journal that the operator put a fresh sheet in: its patches are all free."""
        self.state.sheet += 1
        self._log({"event": "sheet", "sheet": self.state.sheet})

    def ended(self, why: str) -> None:
        """Journal how a run ended before its time: it is shown to whoever resumes the session."""
        self._log({"event": "ended", "why": why})

    def verify(self) -> None:
        """Raise `SessionDamaged` naming the first finished step whose file is missing or has changed."""
        try:
            for line in self.state.segments:
                check_digest(self.folder / str(line["file"]), str(line["sha256"]))
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
        self._log(closed_line(final, self.state.counts()))
        return final

    def release(self) -> None:
        """Release the lock: any process can now resume or read the session."""
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
        """Raise `SessionDamaged` if the journal lost its last lines: their numbers and patches would be used again."""
        for path in sorted(self.folder.glob("*.mcap*")):
            serial = SEGMENT_NAME.fullmatch(path.name)
            if serial and int(serial[1]) >= self.state.begun:
                raise SessionDamaged(self.folder / JOURNAL_NAME, f"does not mention {path.name}: lines are missing")


def lock(folder: Path) -> FileLock:
    """Take the session's lock. Raises `SessionLocked` while another process has it."""
    # One lock for all threads: the engine opens the store in one thread and may release it in another.
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
