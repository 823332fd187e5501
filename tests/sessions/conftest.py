"""Small recordings to look at: `make` makes them, and reads them back without the code under test."""

from __future__ import annotations

import errno
import functools
import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from brushloop.sessions.events import BoardResult, CaptureResult, Condition, Press, PressResult, StepKind, StepResult
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.journal import JOURNAL_NAME, seal
from brushloop.sessions.mcap_writer import Outgoing, SegmentWriter
from brushloop.sessions.messages import encode_png, image_message, pose_message
from brushloop.sessions.records import Header, Source, Stroke, Topic
from brushloop.sessions.repair import Report, repair_session
from brushloop.sessions.store import SessionStore
from tests.journal_lines import read_lines

BOARD = BoardResult(still=1000, corners=54, mm_per_px=0.05, rms_px=0.1, size_px=(24, 24), sheet_px=())


def no_space(*_: object, **__: object) -> None:
    """In place of a call of the system, on a full disk."""
    raise OSError(errno.ENOSPC, "No space left on device")


class Make:
    """Messages, recordings, sessions and folders of photographs, all tiny."""

    t0_ns = 1_700_000_000_000_000_000
    header = Header(
        session_id="2026-01-02-grid-01", source=Source.LOOPBACK, software="brushloop 0", brush="goat", lens="12 mm"
    )
    snapshots: ClassVar = {"rig.toml": 'name = "bench"\n', "protocol.toml": "repeats = 2\n"}

    def clock(self) -> Callable[[], int]:
        return functools.partial(next, itertools.count(self.t0_ns, 1_000_000))

    @functools.cache  # noqa: B019 - one maker for the whole run
    def png(self, seed: int = 0, side: int = 24) -> bytes:
        image = np.full((side, side), 230, np.uint8)
        cv2.circle(image, (side // 2, side // 2), 3 + seed % 7, 20, -1)
        return encode_png(image)

    def pose(self, number: int) -> Outgoing:
        t_ns = self.t0_ns + number
        return Outgoing(Topic.TCP, t_ns, t_ns - 1, number, pose_message(t_ns, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0)))

    def still(self, number: int, data: bytes | None = None) -> Outgoing:
        t_ns = self.t0_ns + number * 1000
        return Outgoing(Topic.STILL, t_ns, t_ns, number, image_message(t_ns, data or self.png(number)))

    def stroke(self, number: int, **fields: Any) -> Outgoing:
        t_ns = self.t0_ns + number * 1000 + 1
        values = {"stroke_id": f"H13-a05-r{number:02d}", "kind": "press", "still": number} | fields
        return Outgoing(Topic.STROKE, t_ns, t_ns, number, Stroke.model_validate(values))

    def strokes(self, count: int) -> list[Outgoing]:
        return [message for number in range(count) for message in (self.still(number), self.stroke(number))]

    def record(self, path: Path, *messages: Outgoing) -> Path:
        """A finished MCAP file with these messages."""
        writer = SegmentWriter(path, self.header)
        for message in messages:
            writer.write(message)
        writer.finish()
        return path

    def store(self, folder: Path, **fields: Any) -> SessionStore:
        header = self.header.model_copy(update=fields)
        return SessionStore.create(folder, header, self.snapshots, self.clock())

    def press(self, stroke_id: str = "H13-a05-r00", depth_mm: float = 13.0, **known: Any) -> Press:
        return Press(stroke_id=stroke_id, condition=Condition(depth_mm=depth_mm, tilt_deg=5.0), **known)

    def captured(self, stroke_id: str, still: int, **known: Any) -> CaptureResult:
        return CaptureResult(press=self.press(stroke_id), still=still, **known)

    def perform(self, store: SessionStore, key: str, patch: int | None = None) -> None:
        """One step from begin to done, with a still and a stroke in it."""
        number = store.state.begun
        shown = [self.still(number), self.stroke(number, stroke_id=key)]
        self.take(store, key, shown, self.captured(key, number), patch)

    def collect(self, store: SessionStore, strokes: int = 2) -> None:
        """A small grid as the engine collects it: a board, presses with poses, captures, and one press that was cut."""
        self.take(store, "board", [self.still(1000)], BOARD)
        store.void(store.begin("H13-a05-r00 press", StepKind.PRESS, patches=(0,)), "stopped by the operator")
        for number in range(strokes):
            stroke, sheet, patch = f"H13-a05-r{number:02d}", store.state.sheet, number + 1
            poses = [self.pose(100 * number + at) for at in range(5)]
            pressed = PressResult(press=self.press(stroke, sheet=sheet, patch=patch, reached_mm=13.0))
            self.take(store, f"{stroke} press", poses, pressed, patch)
            captured = self.captured(stroke, number)
            self.take(store, f"{stroke} capture", [self.still(number), self.stroke(number)], captured)

    def take(
        self, store: SessionStore, key: str, messages: list[Outgoing], result: StepResult, patch: int | None = None
    ) -> None:
        """One step from begin to done."""
        press = result.press if isinstance(result, PressResult | CaptureResult) else None
        attempt = store.begin(key, result.kind, patches=() if patch is None else (patch,), press=press)
        for message in messages:
            attempt.writer.write(message)
        store.done(attempt, result)

    def session(self, folder: Path, strokes: int = 2, /, *, closed: bool = False, **fields: Any) -> Path:
        """The folder of a session that was collected and that no process has."""
        store = self.store(folder, **fields)
        self.collect(store, strokes)
        if closed:
            store.close()
        store.release()
        return folder

    def messages(self, path: Path) -> Counter[tuple[str, int, int, int, bytes]]:
        """Every message, as any MCAP reader finds it, CRCs checked."""
        with path.open("rb") as file:
            found = make_reader(file, validate_crcs=True).iter_messages()
            return Counter((c.topic, m.sequence, m.log_time, m.publish_time, m.data) for _, c, m in found)

    def events(self, folder: Path, kind: str) -> list[dict[str, Any]]:
        return [line for line in read_lines(folder / JOURNAL_NAME) if line["event"] == kind]

    def rewrite_journal(self, folder: Path, event: str, **said: Any) -> None:
        """Have every line of an event say this, as a program would that knows the format."""
        lines = (line | (said if line["event"] == event else {}) for line in read_lines(folder / JOURNAL_NAME))
        data = [seal({"seq": n, "session": self.header.session_id, **line}) for n, line in enumerate(lines, 1)]
        (folder / JOURNAL_NAME).write_bytes(b"".join(data))

    def stroke_names(self, path: Path) -> list[str]:
        """As any MCAP reader finds them, CRCs checked."""
        with path.open("rb") as file:
            messages = make_reader(file, validate_crcs=True).iter_messages(topics=[str(Topic.STROKE)])
            return [Stroke.model_validate_json(message.data).stroke_id for _, _, message in messages]

    def tree(self, folder: Path) -> dict[str, bytes | None]:
        """Everything under a folder, so that two looks can be compared."""
        paths = sorted(folder.rglob("*"))
        return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in paths}

    def photographs(self, folder: Path, *rows: dict[str, str]) -> Path:
        """A folder with a photograph for every row of its `table.csv`; returns the table."""
        folder.mkdir(exist_ok=True)
        for number, row in enumerate(rows):
            (folder / row["file"]).write_bytes(self.png(number))
        table = folder / "table.csv"
        lines = [",".join(fields) for fields in (rows[0], *(row.values() for row in rows))]
        table.write_text("\n".join(lines), encoding="utf-8")
        return table


@pytest.fixture(scope="session")
def make() -> Make:
    return Make()


@pytest.fixture
def store(make: Make, tmp_path: Path) -> Iterator[SessionStore]:
    """A session that has just been created; its folder is `store.folder`."""
    made = make.store(tmp_path / make.header.session_id)
    yield made
    made.release()


@pytest.fixture
def opened(make: Make, tmp_path: Path) -> Path:
    """The folder of an open session of two strokes."""
    return make.session(tmp_path / make.header.session_id)


@pytest.fixture
def closed(make: Make, tmp_path: Path) -> Path:
    """The folder of a closed session of two strokes."""
    return make.session(tmp_path / make.header.session_id, closed=True)


@pytest.fixture
def resume(make: Make) -> Iterator[Callable[[SessionStore | Path], SessionStore]]:
    """Opens a session as the next process would, after the one that has it."""
    stores: list[SessionStore] = []

    def resume(session: SessionStore | Path) -> SessionStore:
        if isinstance(session, SessionStore):
            session.release()
            session = session.folder
        stores.append(SessionStore(session, make.clock()))
        return stores[-1]

    yield resume
    for store in stores:
        store.release()


@pytest.fixture
def repair(make: Make) -> Callable[[Path], Report]:
    return lambda path: repair_session(path, make.clock())


PRESSES = ImportOptions(kind="press", licence="CC0-1.0", origin="a museum", brush="wolf")


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """The folder of photographs, not yet there."""
    return tmp_path / "photos"


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """The session folder that an import makes."""
    return tmp_path / "sessions" / "from-elsewhere"


@pytest.fixture
def run(make: Make, photos: Path, out: Path) -> Callable[..., Path]:
    """Imports `photos/table.csv` into `out`."""

    def run(options: ImportOptions = PRESSES) -> Path:
        return import_photographs(photos, photos / "table.csv", out, options, "brushloop 0", make.clock())

    return run
