"""Export a recording for other tools: images with CSV tables, NumPy arrays, or Parquet.

Every export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. The images are the photographs as they were recorded, byte for byte.
"""

from __future__ import annotations

import zipfile
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from sessions.cells import CsvWriter
from sessions.disk import check_room, staged_folder, sync, write_durably
from sessions.errors import InputError, disk_error
from sessions.export.parquet import write_parquet
from sessions.export.rows import TEXT_COLUMNS, Export, Row
from sessions.progress import Progress, unseen
from sessions.reader import Capture, Recording

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

POSE_COLUMNS = (
    *("episode_index", "frame_index", "t_ns", "log_ns", "sequence"),
    *("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"),
)

DECODED_AHEAD = 2
"""Images that wait while one is packed."""


def export(source: Path, out: Path, kind: str, progress: Progress = unseen) -> Path:
    """Export a session into the new or empty folder `out` as `png`, `npz` or `parquet`.

    Raises `InputError` for an unknown format or a folder that is not empty, `SessionDamaged` for a recording that
    cannot be read; nothing is left behind then.
    """
    writers = {"png": write_png, "npz": write_npz, "parquet": write_parquet}
    if (write := writers.get(kind)) is None:
        raise InputError("--format", f"{kind!r}, allowed: {', '.join(writers)}")
    recording = Recording(source)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever overwritten")
    if recording.strokes() == 0:
        raise InputError(recording.path, "holds no strokes to export")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        with staged_folder(out) as stage:
            write(Export.of(recording, progress), stage)
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    return out


def write_png(export: Export, folder: Path) -> None:
    """Write `images/`, `strokes.csv`, `poses.csv` and `header.json`."""
    (folder / "images").mkdir()
    rows: list[Row] = []
    for row, capture in export.captures():
        write_durably(folder / str(row["file"]), capture.still_png)
        rows.append(row)
    columns = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "strokes.csv").open("x", newline="", encoding="utf-8") as file:
        table = CsvWriter(file, "\r\n")
        table.writerow(columns)
        table.writerows([row.get(name) for name in columns] for row in rows)
        sync(file)
    with (folder / "poses.csv").open("x", newline="", encoding="utf-8") as file:
        lines = CsvWriter(file, "\r\n")
        lines.writerow(POSE_COLUMNS)
        lines.writerows(
            [p.episode_index, p.frame_index, p.t_ns, p.log_ns, p.sequence, *p.position_mm, *p.quaternion]
            for p in export.poses()
        )
        sync(file)
    write_durably(folder / "header.json", export.header_json())


def write_npz(export: Export, folder: Path) -> None:
    """Write `strokes.npz` (loads without pickle) and `header.json`.

    One array per column of the table of strokes, (n,), NaN where a value is missing; `image_0000`, ... (h, w) uint8
    gray; `pose_<column>` (m,), `pose_position_mm` (m, 3) and `pose_quaternion` (m, 4).
    """
    import numpy as np

    rows: list[Row] = []
    with (folder / "strokes.npz").open("xb") as file:
        # Level 6 would take ten times as long for photographs, and save a twentieth of their size.
        with (
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
            ThreadPoolExecutor(2) as threads,
        ):
            reading = threads.submit(lambda: list(export.poses()))
            for row, image in _decoded(threads, export.captures()):
                _add(archive, f"image_{len(rows):04d}", image)
                rows.append(row)
            for name in dict.fromkeys(name for row in rows for name in row):
                values = [row.get(name) for row in rows]
                text = name in TEXT_COLUMNS
                _add(archive, name, np.array(values) if text else np.array(values, np.float64))
            poses = reading.result()
            for name in POSE_COLUMNS[:5]:
                _add(archive, f"pose_{name}", np.array([getattr(pose, name) for pose in poses], np.int64))
            positions = np.array([pose.position_mm for pose in poses], np.float64).reshape(-1, 3)
            _add(archive, "pose_position_mm", positions)
            quaternions = np.array([pose.quaternion for pose in poses], np.float64).reshape(-1, 4)
            _add(archive, "pose_quaternion", quaternions)
        sync(file)
    write_durably(folder / "header.json", export.header_json())


def _decoded(threads: Executor, captures: Iterable[tuple[Row, Capture]]) -> Iterator[tuple[Row, NDArray[np.uint8]]]:
    """Rows with their images; the next images are decoded while one is packed."""
    ahead: deque[tuple[Row, Future[NDArray[np.uint8]]]] = deque()
    for row, capture in captures:
        ahead.append((row, threads.submit(capture.image)))
        if len(ahead) > DECODED_AHEAD:
            row, image = ahead.popleft()
            yield row, image.result()
    for row, image in ahead:
        yield row, image.result()


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[np.generic]) -> None:
    import numpy as np

    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)
