"""Images with CSV tables, and NumPy archives."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sessions.cells import CsvWriter
from sessions.export.export import Export, PoseRow, Row, write_durably

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

POSE_COLUMNS = [
    "episode_index",
    "frame_index",
    "t_ns",
    "log_ns",
    "sequence",
    "x_mm",
    "y_mm",
    "z_mm",
    "qx",
    "qy",
    "qz",
    "qw",
]
TEXT_COLUMNS = ("stroke_id", "file", "session_id", "source", "kind")


def pose_values(pose: PoseRow) -> list[int | float]:
    """The values of `POSE_COLUMNS`."""
    times = [pose.t_ns, pose.log_ns, pose.sequence]
    return [pose.episode_index, pose.frame_index, *times, *pose.position_mm, *pose.quaternion]


def header_json(export: Export) -> bytes:
    """Who recorded what on what, with the digest of the recording."""
    header = export.recording.header.model_dump(mode="json")
    origin = {"file": export.recording.path.name, "sha256": export.recording.sha256}
    return (json.dumps({**header, "exported_from": origin}, indent=2, ensure_ascii=False) + "\n").encode()


def write_png(export: Export, folder: Path) -> None:
    """`images/`, `strokes.csv`, `poses.csv`, `header.json`."""
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
        _sync(file)
    with (folder / "poses.csv").open("x", newline="", encoding="utf-8") as file:
        lines = CsvWriter(file, "\r\n")
        lines.writerow(POSE_COLUMNS)
        lines.writerows(map(pose_values, export.poses()))
        _sync(file)
    write_durably(folder / "header.json", header_json(export))


def write_npz(export: Export, folder: Path) -> None:
    """`strokes.npz` (loads without pickle) and `header.json`.

    One array per column of the table of strokes, (n,), NaN where nothing is told; `image_0000`, ... (h, w) uint8 gray;
    `pose_<column>` (m,), `pose_position_mm` (m, 3) and `pose_quaternion` (m, 4).
    """
    import numpy as np

    rows: list[Row] = []
    with (folder / "strokes.npz").open("xb") as file:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            for row, capture in export.captures():
                _add(archive, f"image_{len(rows):04d}", capture.image())
                rows.append(row)
            for name in dict.fromkeys(name for row in rows for name in row):
                values = [row.get(name) for row in rows]
                text = name in TEXT_COLUMNS
                _add(archive, name, np.array(values) if text else np.array(values, np.float64))
            poses = list(export.poses())
            for name in POSE_COLUMNS[:5]:
                _add(archive, f"pose_{name}", np.array([getattr(pose, name) for pose in poses], np.int64))
            positions = np.array([pose.position_mm for pose in poses], np.float64).reshape(-1, 3)
            _add(archive, "pose_position_mm", positions)
            quaternions = np.array([pose.quaternion for pose in poses], np.float64).reshape(-1, 4)
            _add(archive, "pose_quaternion", quaternions)
        file.flush()
        os.fsync(file.fileno())
    write_durably(folder / "header.json", header_json(export))


def _add(archive: zipfile.ZipFile, name: str, array: NDArray[np.generic]) -> None:
    import numpy as np

    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def _sync(file: Any) -> None:
    file.flush()
    os.fsync(file.fileno())
