"""Export a recording for other tools: its pictures as files, and tables of strokes, poses and forces.

An export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. `images/` holds the photographs as they were recorded, byte for byte, or crops, to which `masks/` belongs.
The tables are CSV or Parquet; values that are not recorded are empty or null. `episode_index`, the number of the
stroke, joins the tables. `header.json` says where everything comes from.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

from brushloop.calibrate.commands import ExportRequest
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.files import Written
from brushloop.calibrate.notebook import RecordedPress, Session
from brushloop.calibrate.presses import Refused
from brushloop.calibrate.stats import odd_waits
from brushloop.calibrate.stroke.preprocess import PX_PER_MM
from brushloop.sessions.disk import check_room, csv_text, staged_folder
from brushloop.sessions.errors import InputError, SessionDamaged, disk_error
from brushloop.sessions.messages import PNG_START, encode_png
from brushloop.sessions.records import Header, Stroke, Topic
from brushloop.sessions.terminal import Progress, counted, unseen

STROKE_COLUMNS = ("kind", "depth_mm", "reached_mm", "tilt_deg", "dip_to_touch_s", "heading_deg")
PATCH_COLUMNS = ("cell_x_mm", "cell_y_mm", "cell_width_mm", "cell_height_mm")
Row = dict[str, Any]


def export(request: ExportRequest, progress: Progress = unseen) -> Written:
    """Export a session into a new or empty folder, with tables as `csv` or `parquet`.

    With `crops`, every photograph is replaced by a crop and its mask, by the calibration in use. Raises `InputError`
    for an unknown format, a folder that is not empty, or a session of which no stroke can be cropped,
    `CalibrationError` for crops of a session that was not calibrated, and `SessionDamaged` for a recording that cannot
    be read; nothing is left behind then.
    """
    out, kind, crops = request.out, request.kind, request.crops
    if kind not in ("csv", "parquet"):
        raise InputError("--format", f"{kind!r}, allowed: csv, parquet")
    session = Session(request.session)
    recording = session.recording
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever overwritten")
    if recording.counts[Topic.STROKE] == 0:
        raise InputError(recording.path, "holds no strokes to export")
    if crops:
        _ = session.calibration  # refused here if it was not calibrated
    left_out: list[Refused] = []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        with staged_folder(out) as stage:
            rows = _write_pictures(session, stage, left_out, progress, crops=crops)
            if not rows:
                raise InputError(recording.path, "holds no stroke that can be cropped: {} {}".format(*left_out[0]))
            columns = dict.fromkeys(name for row in rows for name in row)
            _write_table(stage / f"strokes.{kind}", {name: [row.get(name) for row in rows] for name in columns})
            sampled = {"poses": session.poses}
            if recording.counts.get(Topic.WRENCH, 0):
                sampled["forces"] = session.forces
            for name, samples in sampled.items():
                fields = samples.dtype.names or ()
                _write_table(stage / f"{name}.{kind}", {field: samples[field].tolist() for field in fields})
            origin = {"file": recording.path.name, "sha256": recording.sha256}
            header = recording.header.model_dump(mode="json") | {"exported_from": origin}
            (stage / "header.json").write_text(json.dumps(header, indent=2, ensure_ascii=False) + "\n", "utf-8")
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    named = (f"left out: {stroke_id}: {reason}" for stroke_id, reason in left_out)
    return Written(out, (f"Exported into {out}", *named), left_out)


def _write_pictures(
    session: Session, folder: Path, left_out: list[Refused], progress: Progress, *, crops: bool
) -> list[Row]:
    """Write the pictures; returns a row for each stroke, None where a value is not recorded."""
    strokes = session.recording.stroke_records()
    waits = {stroke.stroke_id: wait for stroke in strokes if (wait := stroke.dip_to_touch_s) is not None}
    odd, rows, total = odd_waits(waits), list[Row](), session.recording.counts[Topic.STROKE]
    for index, press in enumerate(counted(session.presses(), "strokes exported", total, progress)):
        try:
            values, pictures = _cropped(press) if crops else ({}, {"image": press.capture.still_png})
        except (CaptureRefused, SessionDamaged) as error:
            left_out.append((press.name, error.what))
            continue
        row = {"episode_index": index, "file": ""} | _row(session.header, press.capture.stroke)
        row["dip_to_touch_unlike"] = float(press.name in odd) if press.name in waits else None
        row |= {"quality": session.verdicts.get(press.name, ""), "marked_bad": press.capture.bad} | values
        # Readable, safe on any file system, and with the index distinct whatever the strokes are called.
        safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in press.name)[:80]
        for name, data in pictures.items():
            path = f"{name}s/{index:04d}-{safe}.{'png' if data.startswith(PNG_START) else 'jpg'}"
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_bytes(data)
            row["file" if name == "image" else f"{name}_file"] = path
        rows.append(row)
    return rows


def _cropped(press: RecordedPress) -> tuple[Row, dict[str, bytes]]:
    """What a crop adds to the row of its stroke, and its pictures by name, as PNG."""
    raster, ink, prepared = press.crop
    values = {"flags": "; ".join(prepared.flags), **_pair("px_per_mm_{}", (PX_PER_MM, PX_PER_MM))}
    pictures = {"image": encode_png(raster), "mask": encode_png(ink.astype("uint8") * 255)}
    return values | _pair("start_{}_px", prepared.anchor_px), pictures


def _row(header: Header, stroke: Stroke) -> Row:
    """Every value of a stroke that depends neither on its photograph nor on other strokes."""
    return {
        "stroke_id": stroke.stroke_id,
        "session_id": header.session_id,
        "source": str(header.source),
        **{name: getattr(stroke, name) for name in STROKE_COLUMNS},
        **_pair("start_{}_mm", stroke.anchor_mm),
        **_pair("start_{}_px", stroke.anchor_px),
        **_pair("px_per_mm_{}", stroke.px_per_mm),
        **dict(zip(PATCH_COLUMNS, stroke.cell_mm or (None,) * len(PATCH_COLUMNS), strict=True)),
        "licence": header.licence,
        **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
    }


def _pair(column: str, values: tuple[float, float] | None) -> Row:
    """Two columns, `{}` in whose name stands for x and y."""
    return dict(zip((column.format("x"), column.format("y")), values or (None, None), strict=True))


def _write_table(path: Path, table: dict[str, list[Any]]) -> None:
    """Write columns as the suffix of the path says."""
    if path.suffix == ".csv":
        path.write_bytes(csv_text(list(table), zip(*table.values(), strict=True), "\r\n").encode())
        return
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError("--format", "parquet needs pyarrow: pip install pyarrow") from None
    pq.write_table(pa.table(table), path)
