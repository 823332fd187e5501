"""Export a recording for other tools: its pictures as files, and tables of strokes, poses and forces.

An export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. `images/` holds the photographs as they were recorded, byte for byte, or crops, to which `masks/` belongs.
The tables are CSV or Parquet; values that are not recorded are empty or null. `episode_index`, the number of the
stroke, joins the tables. `header.json` says where everything comes from.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stats import odd_waits
from brushloop.sessions.disk import check_room, csv_text, staged_folder
from brushloop.sessions.errors import InputError, SessionDamaged, disk_error
from brushloop.sessions.events import Begin, StepEvent, StepKind
from brushloop.sessions.messages import PNG_START, encode_png
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Quality, Stroke, Topic, Wrench
from brushloop.sessions.terminal import Progress, counted, unseen

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMATS = ("csv", "parquet")
PATCH_COLUMNS = ("cell_x_mm", "cell_y_mm", "cell_width_mm", "cell_height_mm")
SAMPLE_COLUMNS = ("episode_index", "frame_index", "t_ns", "log_ns", "sequence")
"""Numbers of the stroke and of the sample within it; times at the device and the recorder; the sample's own number."""
Row = dict[str, Any]
Refused = tuple[str, str]
"""(stroke, reason) of one that could not be cropped."""
Cropped = tuple[Row, dict[str, bytes]]
"""What a crop adds to the row of its stroke, and its pictures by name, as PNG."""


@dataclass(frozen=True, slots=True)
class Series:
    """A topic whose samples during the presses are a table of every export."""

    name: str
    topic: Topic
    columns: tuple[str, ...]
    values: Callable[[bytes], tuple[float, ...]]
    """Values of the columns in a message. Raises `DecodeError` or `ValidationError`."""


def _pose(data: bytes) -> tuple[float, ...]:
    pose = PoseInFrame.FromString(data).pose
    at, turned = pose.position, pose.orientation
    return at.x * 1e3, at.y * 1e3, at.z * 1e3, turned.x, turned.y, turned.z, turned.w


def _wrench(data: bytes) -> tuple[float, ...]:
    return tuple(Wrench.model_validate_json(data).model_dump().values())


POSES = Series("pose", Topic.TCP, ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw"), _pose)
"""Of the brush tip, in the robot's base frame."""
FORCES = Series("force", Topic.WRENCH, tuple(Wrench.model_fields), _wrench)
"""In the sensor's own frame."""


def samples(recording: Recording, series: Series) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(n, 5) `SAMPLE_COLUMNS` and (n, w) values of the messages during presses, in the order of the recording.

    Raises `SessionDamaged`.
    """
    import numpy as np

    numbers = {stroke.stroke_id: number for number, stroke in enumerate(recording.stroke_records())}
    when: list[tuple[int, ...]] = []
    values: list[tuple[float, ...]] = []
    current, frame, on = -1, 0, series.topic
    try:
        for _schema, channel, message in recording.messages(Topic.STEP, series.topic):
            on = channel.topic
            if on == Topic.STEP:
                step = StepEvent.model_validate_json(message.data).step
                pressed = step.press if isinstance(step, Begin) and step.kind != StepKind.CAPTURE else None
                current, frame = -1 if pressed is None else numbers.get(pressed.stroke_id, -1), 0
            elif current >= 0:
                when.append((current, frame, message.publish_time, message.log_time, message.sequence))
                values.append(series.values(message.data))
                frame += 1
    except (ValidationError, DecodeError):
        raise SessionDamaged(recording.path, f"a message on {on} does not fit its schema") from None
    return np.array(when, np.int64).reshape(-1, 5), np.array(values, np.float64).reshape(-1, len(series.columns))


def verdicts(recording: Recording) -> dict[str, str]:
    """`passed`, or `failed: ...`, by the name of each stroke that was judged. Raises `SessionDamaged`."""
    return {judged.stroke_id: judged.verdict for judged in recording.events(Topic.QUALITY, Quality)}


def export(
    source: Path,
    out: Path,
    kind: str,
    progress: Progress = unseen,
    *,
    crops: bool = False,
) -> list[Refused]:
    """Export a session into the new or empty folder `out`, with tables as `csv` or `parquet`.

    With `crops`, every photograph is replaced by a crop and its mask, by the calibration in use; returns the
    strokes that could not be cropped. Raises `InputError` for an unknown format, a folder that is not empty, or a
    session of which no stroke can be cropped, `SessionDamaged` for a recording that cannot be read; nothing is left
    behind then.
    """
    if kind not in FORMATS:
        raise InputError("--format", f"{kind!r}, allowed: {', '.join(FORMATS)}")
    recording = Recording(source)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever overwritten")
    if recording.counts[Topic.STROKE] == 0:
        raise InputError(recording.path, "holds no strokes to export")
    crop = _cropper(recording) if crops else None
    left_out: list[Refused] = []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        with staged_folder(out) as stage:
            rows = _write_pictures(recording, stage, crop, left_out, progress)
            if not rows:
                raise InputError(recording.path, "holds no stroke that can be cropped: {} {}".format(*left_out[0]))
            columns = dict.fromkeys(name for row in rows for name in row)
            _write_table(stage / f"strokes.{kind}", {name: [row.get(name) for row in rows] for name in columns})
            for series in (POSES, FORCES) if recording.counts.get(Topic.WRENCH, 0) else (POSES,):
                when, values = samples(recording, series)
                arrays = (*when.T.tolist(), *values.T.tolist())
                table = dict(zip((*SAMPLE_COLUMNS, *series.columns), arrays, strict=True))
                _write_table(stage / f"{series.name}s.{kind}", table)
            origin = {"file": recording.path.name, "sha256": recording.sha256}
            header = recording.header.model_dump(mode="json") | {"exported_from": origin}
            (stage / "header.json").write_text(json.dumps(header, indent=2, ensure_ascii=False) + "\n", "utf-8")
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    return left_out


def _cropper(recording: Recording) -> Callable[[Capture], Cropped]:
    """Make what crops a recording's captures, by the calibration in use.

    Raises `CalibrationError` where a session was not calibrated; an import needs no calibration.
    """
    # Photographs are exported without the libraries that crops need.
    from brushloop.calibrate.presses import crop
    from brushloop.calibrate.session import calibration_of
    from brushloop.calibrate.stroke import PX_PER_MM

    calibration = calibration_of(recording, next(recording.stroke_records()))

    def cropped(capture: Capture) -> Cropped:
        raster, ink, prepared = crop(capture, calibration)
        values = {"flags": "; ".join(prepared.flags), **_pair("px_per_mm_{}", (PX_PER_MM, PX_PER_MM))}
        pictures = {"image": encode_png(raster), "mask": encode_png(ink.astype("uint8") * 255)}
        return values | _pair("anchor_{}_px", prepared.anchor_px), pictures

    return cropped


def _write_pictures(
    recording: Recording,
    folder: Path,
    crop: Callable[[Capture], Cropped] | None,
    left_out: list[Refused],
    progress: Progress,
) -> list[Row]:
    """Write the pictures; returns a row for each stroke, None where a value is not recorded."""
    waits = {one.stroke_id: one.dip_to_touch_s for one in recording.stroke_records() if one.dip_to_touch_s is not None}
    odd, judged = odd_waits(waits), verdicts(recording)
    total, rows = recording.counts[Topic.STROKE], list[Row]()
    for index, capture in enumerate(counted(recording.captures(), "strokes exported", total, progress)):
        stroke = capture.stroke
        try:
            values, pictures = ({}, {"image": capture.still_png}) if crop is None else crop(capture)
        except (CaptureRefused, SessionDamaged) as error:
            left_out.append((stroke.stroke_id, error.what))
            continue
        row = {"episode_index": index, "file": ""} | _row(recording, stroke, judged.get(stroke.stroke_id, ""))
        row["dip_to_touch_unlike"] = float(stroke.stroke_id in odd) if stroke.stroke_id in waits else None
        row |= {"marked_bad": capture.bad} | values
        for name, data in pictures.items():
            path = _file_name(index, stroke.stroke_id, name, data)
            (folder / path).parent.mkdir(exist_ok=True)
            (folder / path).write_bytes(data)
            row["file" if name == "image" else f"{name}_file"] = path
        rows.append(row)
    return rows


def _row(recording: Recording, stroke: Stroke, quality: str) -> Row:
    """Every value of a stroke that depends neither on its photograph nor on other strokes."""
    header = recording.header
    return {
        "stroke_id": stroke.stroke_id,
        "session_id": header.session_id,
        "source": str(header.source),
        "kind": stroke.kind,
        "depth_mm": stroke.depth_mm,
        "reached_mm": stroke.reached_mm,
        "tilt_deg": stroke.tilt_deg,
        "dip_to_touch_s": stroke.dip_to_touch_s,
        "dip_to_touch_unlike": None,
        "heading_deg": stroke.heading_deg,
        **_pair("anchor_{}_mm", stroke.anchor_mm),
        **_pair("anchor_{}_px", stroke.anchor_px),
        **_pair("px_per_mm_{}", stroke.px_per_mm),
        **dict(zip(PATCH_COLUMNS, stroke.cell_mm or (None,) * len(PATCH_COLUMNS), strict=True)),
        "quality": quality,
        "marked_bad": "",
        "licence": header.licence,
        **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
    }


def _pair(column: str, values: tuple[float, float] | None) -> Row:
    """Two columns, `{}` in whose name stands for x and y."""
    return dict(zip((column.format("x"), column.format("y")), values or (None, None), strict=True))


def _file_name(index: int, stroke_id: str, picture: str, data: bytes) -> str:
    """A readable path, safe on any file system and distinct whatever the strokes are called."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke_id)[:80]
    return f"{picture}s/{index:04d}-{safe}.{'png' if data.startswith(PNG_START) else 'jpg'}"


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
