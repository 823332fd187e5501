"""Export a recording for other tools: images with CSV tables, NumPy arrays, or Parquet.

Every export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. The images are the photographs as they were recorded, byte for byte, or crops and masks by a cropper.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path

from brushloop.sessions.cells import CsvWriter
from brushloop.sessions.disk import check_room, staged_folder, sync, write_durably
from brushloop.sessions.errors import InputError, disk_error
from brushloop.sessions.export.npz import SAMPLE_COLUMNS, write_npz
from brushloop.sessions.export.parquet import write_parquet
from brushloop.sessions.export.rows import Cropper, Export, ForceRow, PoseRow, Row
from brushloop.sessions.progress import Progress, unseen
from brushloop.sessions.recording import Recording
from brushloop.sessions.spool import Spool

POSE_COLUMNS = (*SAMPLE_COLUMNS, "x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
FORCE_COLUMNS = (*SAMPLE_COLUMNS, "fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm")


def export(
    source: Path,
    out: Path,
    kind: str,
    progress: Progress = unseen,
    make_cropper: Callable[[Recording], Cropper] | None = None,
    *,
    frames: bool = False,
) -> list[tuple[str, str]]:
    """Export a session into the new or empty folder `out` as `png`, `npz` or `parquet`.

    With `make_cropper`, every photograph is replaced by a crop and its mask; `frames` keeps the whole photograph as
    well. Returns (stroke, reason) of the strokes that could not be cropped. Raises `InputError` for an unknown format,
    a folder that is not empty, or a session of which no stroke can be cropped, `SessionDamaged` for a recording that
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
        cropper = None if make_cropper is None else make_cropper(recording)
        with staged_folder(out) as stage:
            exported = Export.of(recording, progress, cropper, frames=frames)
            write(exported, stage)
            if len(exported.left_out) == len(exported.numbers):
                stroke_id, reason = exported.left_out[0]
                raise InputError(recording.path, f"holds no stroke that can be cropped: {stroke_id} {reason}")
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    return exported.left_out


def write_png(export: Export, folder: Path) -> None:
    """Write `images/`, `strokes.csv`, `poses.csv`, `forces.csv` where there are any, and `header.json`.

    With a cropper also `masks/`, and `frames/` if asked.
    """
    for name in export.pictures:
        (folder / f"{name}s").mkdir()
    rows: Spool[Row] = Spool(json.dumps, json.loads)
    columns: dict[str, None] = {}
    for row, pictures in export.captures():
        for name, data in pictures.items():
            write_durably(folder / str(row["file" if name == "image" else f"{name}_file"]), data)
        rows.append(row)
        columns |= dict.fromkeys(row)
    with (folder / "strokes.csv").open("x", newline="", encoding="utf-8") as file:
        table = CsvWriter(file, "\r\n")
        table.writerow(columns)
        table.writerows([row.get(name) for name in columns] for row in rows)
        sync(file)
    _write_samples(
        folder / "poses.csv", POSE_COLUMNS, ([*_when(p), *p.position_mm, *p.quaternion] for p in export.poses())
    )
    if export.has_force:
        _write_samples(folder / "forces.csv", FORCE_COLUMNS, ([*_when(one), *one.wrench] for one in export.forces()))
    write_durably(folder / "header.json", export.header_json())


def _when(sample: PoseRow | ForceRow) -> list[float]:
    return [getattr(sample, name) for name in SAMPLE_COLUMNS]


def _write_samples(path: Path, columns: tuple[str, ...], rows: Iterable[list[float]]) -> None:
    with path.open("x", newline="", encoding="utf-8") as file:
        lines = CsvWriter(file, "\r\n")
        lines.writerow(columns)
        lines.writerows(rows)
        sync(file)
