"""NumPy arrays of an export in one file, `strokes.npz`, which loads without pickle.

Nothing that grows with the number of strokes is held in memory: pictures are written as they come, and the columns of
numbers and texts wait in temporary files.
"""

from __future__ import annotations

import itertools
import json
import math
import tempfile
from array import array
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO, Literal

from brushloop.sessions.disk import sync, write_durably
from brushloop.sessions.export.npz_file import NpzFile, Packed, npy_header, packed_image
from brushloop.sessions.export.rows import Export, ForceRow, PoseRow, Row
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.spool import Spool

SAMPLE_COLUMNS = ("episode_index", "frame_index", "t_ns", "log_ns", "sequence")
PACKED_AHEAD = 4
"""Strokes whose pictures are decoded and compressed while one is written."""
VALUES_WAITING = 4096
"""Of a column, in memory."""


def write_npz(export: Export, folder: Path) -> None:
    """Write `strokes.npz` and `header.json`.

    One array per column of the table of strokes, (n,), NaN where a value is missing; `image_0000`, ... (h, w) uint8
    gray; `pose_<column>` (m,), `pose_position_mm` (m, 3) and `pose_quaternion` (m, 4). With a force sensor also
    `force_<column>` (k,) and `force_wrench` (k, 6), with a cropper `mask_0000`, and `frame_0000` if asked.
    """
    with (folder / "strokes.npz").open("xb") as file:
        archive = NpzFile(file)
        with ThreadPoolExecutor(3) as threads:
            samples = threads.submit(_samples, export)
            numbers: dict[str, Numbers] = {}
            texts = {name: Texts() for name in export.text_columns}
            count = itertools.count()
            for row, members in _packed(threads, export.captures()):
                for member in members:
                    archive.add(member)
                _note(row, next(count), numbers, texts)
            for name, column in {**texts, **numbers, **samples.result()}.items():
                archive.add_pieces(name, column.pieces())
        archive.finish()
        sync(file)
    write_durably(folder / "header.json", export.header_json())


class Numbers:
    """A column of numbers, of 8 bytes each, `width` in a row."""

    def __init__(self, kind: Literal["d", "q"], width: int | None = None) -> None:
        self._waiting: array[Any] = array(kind)
        self._width = width
        self._file: BinaryIO | None = None
        self._values = 0

    def extend(self, values: Iterable[float]) -> None:
        """Append numbers."""
        self._waiting.extend(values)
        if len(self._waiting) >= VALUES_WAITING:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
            self._waiting.tofile(self._file)
            self._values += len(self._waiting)
            del self._waiting[:]

    def __len__(self) -> int:
        return self._values + len(self._waiting)

    def pieces(self) -> Iterator[bytes]:
        """The member's bytes; after that the column is used up."""
        import numpy as np

        shape = (len(self),) if self._width is None else (len(self) // self._width, self._width)
        yield npy_header(np.dtype("<f8" if self._waiting.typecode == "d" else "<i8"), shape)
        if self._file is not None:
            with self._file as file:
                file.seek(0)
                while piece := file.read(8 * VALUES_WAITING):
                    yield piece
        yield self._waiting.tobytes()


class Texts:
    """A column of texts."""

    def __init__(self) -> None:
        self._spool: Spool[str] = Spool(json.dumps, json.loads)
        self._longest = 1

    def append(self, text: str) -> None:
        """Append a text."""
        self._spool.append(text)
        self._longest = max(self._longest, len(text))

    def pieces(self) -> Iterator[bytes]:
        """The member's bytes."""
        import numpy as np

        dtype = np.dtype(f"<U{self._longest}")
        yield npy_header(dtype, (len(self._spool),))
        texts = iter(self._spool)
        while some := list(itertools.islice(texts, max(1, VALUES_WAITING // self._longest))):
            yield np.array(some, dtype).tobytes()


def _note(row: Row, before: int, numbers: dict[str, Numbers], texts: dict[str, Texts]) -> None:
    """Append a row to its columns. A column that begins late, or is not in this row, gets NaN."""
    for name, column in texts.items():
        column.append(row.get(name) or "")
    for name in row:
        if name not in texts and name not in numbers:
            numbers[name] = Numbers("d")
            for _ in range(before):
                numbers[name].extend((math.nan,))
    for name, column in numbers.items():
        value = row.get(name)
        column.extend((math.nan if value is None else value,))


def _samples(export: Export) -> dict[str, Numbers]:
    """The columns of poses and forces by name."""
    times = [f"pose_{name}" for name in SAMPLE_COLUMNS]
    columns = {name: Numbers("q") for name in times}
    columns |= {"pose_position_mm": Numbers("d", 3), "pose_quaternion": Numbers("d", 4)}
    for pose in export.poses():
        _time(columns, "pose", pose)
        columns["pose_position_mm"].extend(pose.position_mm)
        columns["pose_quaternion"].extend(pose.quaternion)
    if export.has_force:
        columns |= {f"force_{name}": Numbers("q") for name in SAMPLE_COLUMNS} | {"force_wrench": Numbers("d", 6)}
        for force in export.forces():
            _time(columns, "force", force)
            columns["force_wrench"].extend(force.wrench)
    return columns


def _time(columns: dict[str, Numbers], stem: str, sample: PoseRow | ForceRow) -> None:
    for name in SAMPLE_COLUMNS:
        columns[f"{stem}_{name}"].extend((getattr(sample, name),))


def _packed(threads: Executor, captures: Iterable[tuple[Row, dict[str, bytes]]]) -> Iterator[tuple[Row, list[Packed]]]:
    """Rows with their pictures; the next ones are decoded and compressed while one is written."""

    def pack(number: int, row: Row, pictures: dict[str, bytes]) -> list[Packed]:
        where = f"stroke {row['stroke_id']}"
        return [packed_image(f"{name}_{number:04d}", decode_gray(data, where)) for name, data in pictures.items()]

    ahead: deque[tuple[Row, Future[list[Packed]]]] = deque()
    for number, (row, pictures) in enumerate(captures):
        ahead.append((row, threads.submit(pack, number, row, pictures)))
        if len(ahead) > PACKED_AHEAD:
            row, members = ahead.popleft()
            yield row, members.result()
    for row, members in ahead:
        yield row, members.result()
