"""A session's folder: named, found, and opened for writing; created, locked, resumed, closed.

The engine writes only through this.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from brushloop.sessions import events
from brushloop.sessions.disk import (
    SEGMENT_NAME,
    check_digest,
    check_folder,
    check_room,
    file_sha256,
    fsync_folder,
    set_aside,
    write_durably,
)
from brushloop.sessions.errors import InputError, SessionDamaged, SessionError, SessionLocked, disk_error
from brushloop.sessions.events import Begin, Done, Event, Press, StepEvent, StepKind, StepResult, serial_of
from brushloop.sessions.journal import JOURNAL_NAME, Journal, RunState, read_header, replay
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.mcap_writer import Outgoing, SegmentWriter, new_mcap
from brushloop.sessions.recording import merged_file
from brushloop.sessions.records import REPAIRS_FILE, Header, Topic

STEP_BYTES = 64 * 1024 * 1024
"""Room needed on the disk before a step begins: more than the photographs and poses of any one step."""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a step, with its file open."""

    begin: Begin
    serial: int
    """Number of the attempt, unique in the session."""
    writer: SegmentWriter


class SessionStore:
    """One open session, under its lock; opening it resumes it.

    Raises `InputError` if it cannot be resumed, and `SessionDamaged` (its note names `brushloop sessions repair`).
    """

    def __init__(self, folder: Path, now_ns: Callable[[], int]) -> None:
        self.folder = folder
        self._now_ns = now_ns
        if not (folder / JOURNAL_NAME).is_file():
            raise InputError(folder, f"holds no {JOURNAL_NAME}: not a session that was collected")
        check_folder(folder)
        self._lock = lock(folder)
        self._journal: Journal | None = None
        try:
            self.state = replay(folder / JOURNAL_NAME)
            if self.state.closed is not None:
                raise InputError(folder, "is closed; a finished recording is never changed")
            self.header = read_header(folder, self.state)
            self._check_serials()
            self._journal = Journal(folder / JOURNAL_NAME, self.header.session_id)
            self._log(events.Process(t_ns=now_ns()))
        except BaseException as error:
            if isinstance(error, SessionDamaged):
                error.add_note(f"Try `brushloop sessions repair {folder}`.")
            self.release()
            raise

    @classmethod
    def create(cls, folder: Path, header: Header, snapshots: dict[str, str], now_ns: Callable[[], int]) -> SessionStore:
        """Make a new session folder and open it. Raises `InputError` where it exists.

        `snapshots` are the texts of its configuration by file name, which the journal keeps as well.
        """
        try:
            folder.mkdir(parents=True)
            for name, text in snapshots.items():
                write_durably(folder / name, text.encode())
            fsync_folder(folder.parent)
        except FileExistsError:
            raise InputError(folder, "exists already; recordings are never overwritten") from None
        except OSError as error:
            raise disk_error(folder, "cannot create", error) from error
        journal = Journal(folder / JOURNAL_NAME, header.session_id)
        try:
            journal.append(events.Open(t_ns=now_ns(), header=header, snapshots=snapshots))
        finally:
            journal.close()
        return cls(folder, now_ns)

    def begin(self, key: str, kind: StepKind, *, patches: tuple[int, ...] = (), press: Press | None = None) -> Attempt:
        """Journal that an attempt starts, then open its file.

        `patches` are those that it marks. Raises `DiskFull`, or `SessionError` for a press on a sheet that may hold an
        unrecorded one, before anything is written.
        """
        check_room(self.folder, STEP_BYTES)
        state = self.state
        if patches and state.sheet in state.doubtful_sheets:
            raise SessionError(
                self.folder,
                f"the record of a press on sheet {state.sheet + 1} was lost, so any of its patches may already hold "
                f"ink. Put a fresh sheet in, then run the same command with --sheet {state.sheet + 2}",
            )
        serial = state.begun
        begin = Begin(
            t_ns=self._now_ns(),
            key=key,
            kind=kind,
            attempt=state.attempts.get(key, 0) + 1,
            sheet=state.sheet,
            patches=patches,
            press=press,
            file=f"{serial:04d}-{kind}-{key[:8]}.mcap",
        )
        self._log(begin)
        writer = SegmentWriter(self.folder / begin.file, self.header)
        writer.write(step_message(begin))
        return Attempt(begin, serial, writer)

    def done(self, attempt: Attempt, result: StepResult) -> None:
        """Finish the file, then journal `done`: after this the step is never done again."""
        begin, writer = attempt.begin, attempt.writer
        step = begin.model_dump(exclude={"event", "press", "t_ns"})
        counts = {**writer.counts, Topic.STEP: 2}
        done = Done(**step, t_ns=self._now_ns(), sha256="", counts=counts, result=result)
        try:
            writer.write(step_message(done))
        except SessionError:
            writer.abandon()
            raise
        self._log(done.model_copy(update={"sha256": writer.finish()}))

    def void(self, attempt: Attempt, why: str) -> None:
        """Journal that an attempt was cut; its part file is kept as evidence, and its patch stays used."""
        attempt.writer.abandon()
        self._log(events.Void(t_ns=self._now_ns(), key=attempt.begin.key, attempt=attempt.begin.attempt, why=why))

    def fresh_sheet(self) -> None:
        """Journal that the operator put a fresh sheet in: its patches are all free."""
        self._log(events.FreshSheet(t_ns=self._now_ns(), sheet=self.state.sheet + 1))

    def ended(self, why: str) -> None:
        """Journal how a run ended before its time: it is shown to whoever resumes the session."""
        self._log(events.Ended(t_ns=self._now_ns(), why=why))

    def verify(self) -> None:
        """Raise `SessionDamaged` naming the first finished step whose file is missing or has changed."""
        try:
            for step in self.state.files.values():
                check_digest(self.folder / step.file, step.sha256)
        except SessionDamaged as error:
            error.add_note(f"Try `brushloop sessions repair {self.folder}`.")
            raise

    def close(self) -> Path:
        """Verify every segment, merge, read back, journal `closed`. Returns the merged file.

        Raises `SessionDamaged`, or `DiskFull` before anything is written; the session then stays open.
        """
        self.verify()
        check_room(self.folder, sum((self.folder / file).stat().st_size for file in self.state.files))
        final = merge_session(self.folder, self.state, self.header)
        self._log(closed(final, self.state.counts(), self._now_ns()))
        return final

    def release(self) -> None:
        """Release the lock: any process can now resume or read the session."""
        try:
            if self._journal is not None:
                self._journal.close()
        finally:
            self._journal = None
            self._lock.release()

    def _log(self, event: Event) -> None:
        assert self._journal is not None, "the store was released"
        self._journal.append(event)
        self.state.apply(event)

    def _check_serials(self) -> None:
        """Raise `SessionDamaged` if the journal lost its last lines: their numbers and patches would be used again."""
        for path in sorted(self.folder.glob("*.mcap*")):
            serial = SEGMENT_NAME.fullmatch(path.name)
            if serial and int(serial[1]) >= self.state.begun:
                raise SessionDamaged(self.folder / JOURNAL_NAME, f"does not mention {path.name}: lines are missing")


def merge_session(folder: Path, state: RunState, header: Header, tag: str = "superseded") -> Path:
    """Merge the finished steps of a session into its one MCAP file, in the order of the journal.

    The file includes the configuration and a list of any repairs, so that it can be shared alone. It gets its name
    once it was read back with correct CRCs and the journal's counts. A file of that name, left by an interrupted close,
    is kept beside it under `tag`. Raises `SessionDamaged` naming the step that cannot be read, or the wrong counts.
    """
    final = merged_file(folder, state)
    if final.exists():
        set_aside(final, tag)
    part = final.with_name(final.name + ".part")
    expected = state.counts()
    try:
        part.unlink(missing_ok=True)  # only a copy of steps that still exist
        snapshots = {} if state.opened is None else state.opened.snapshots
        attachments = {name: text.encode() for name, text in snapshots.items()}
        if state.repairs:
            repairs = [repair.model_dump(mode="json") for repair in state.repairs]
            attachments[REPAIRS_FILE] = json.dumps(repairs, indent=1).encode()
        with new_mcap(part, header, attachments) as writer:
            for file in state.files:
                writer.copy_file(folder / file)
        counts = dict(McapFile(part, check=True).sound().counts)
        if counts != expected:
            raise SessionDamaged(part, f"holds {counts}, but the journal says {expected}")
        part.rename(final)
        fsync_folder(final.parent)
    except OSError as error:
        raise disk_error(part, "cannot write", error) from error
    return final


def step_message(event: Begin | Done) -> Outgoing:
    """The message that tells the begin or the end of a step in its file."""
    return Outgoing(Topic.STEP, event.t_ns, event.t_ns, serial_of(event.file), StepEvent(step=event))


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


def closed(final: Path, counts: dict[str, int], t_ns: int) -> events.Closed:
    """The event of a closed session."""
    return events.Closed(t_ns=t_ns, file=final.name, sha256=file_sha256(final), counts=counts)
