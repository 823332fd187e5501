"""Export a recording for other tools: its pictures as files, and tables of strokes, poses and forces.

An export is a folder, written under a temporary name and renamed when complete; a folder that is not empty is never
written to. The pictures are the photographs as they were recorded, byte for byte, or crops and masks by a cropper, one
at a time; the tables are held in memory. `header.json` says where everything comes from.

`images/`, with a cropper `masks/`, and by format:
`csv`      strokes.csv, poses.csv, forces.csv
`parquet`  strokes.parquet, poses.parquet, forces.parquet
`npz`      strokes.npz, poses.npz, forces.npz: an array per column, (n,), which loads without pickle

Values that are not recorded are empty, null or NaN. `episode_index`, the number of the stroke, joins the tables, and
the column `file` of a stroke names its picture.
"""

from __future__ import annotations

import importlib
import json
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.waits import unlike
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


TEXTS = ("stroke_id", "file", "session_id", "source", "kind", "quality", "marked_bad", "licence", "mask_file", "flags")
"""Columns of text."""
PATCH_COLUMNS = ("cell_x_mm", "cell_y_mm", "cell_width_mm", "cell_height_mm")
SAMPLE_COLUMNS = ("episode_index", "frame_index", "t_ns", "log_ns", "sequence")
"""Numbers of the stroke and of the sample within it; times at the device and the recorder; the sample's own number."""
Row = dict[str, Any]
Table = dict[str, list[Any]]
"""Columns by name."""
TableWriter = Callable[[Path, Table], None]
"""Writes a table under a name without its suffix."""


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


Cropped = tuple[Row, dict[str, bytes]]
"""What a crop adds to the row of its stroke, and its pictures by name, as PNG."""


class Export:
    """The rows from which every format is written: strokes with their pictures, poses, and forces."""

    def __init__(self, recording: Recording, crop: Callable[[Capture], Cropped] | None = None) -> None:
        """`crop` makes the pictures of a capture, the photographs are taken without one.

        Raises `SessionDamaged` where a stroke appears twice.
        """
        self.recording = recording
        self._crop = crop
        self.strokes: dict[str, Stroke] = {}
        for stroke in recording.stroke_records():
            if self.strokes.setdefault(stroke.stroke_id, stroke) is not stroke:
                raise SessionDamaged(recording.path, f"holds stroke {stroke.stroke_id} twice")
        waits = {name: wait for name, stroke in self.strokes.items() if (wait := stroke.dip_to_touch_s) is not None}
        self._odd = frozenset(unlike(waits))
        self.quality = {judged.stroke_id: judged.verdict for judged in recording.events(Topic.QUALITY, Quality)}
        """`passed`, or `failed: ...`, by the name of each stroke that was judged."""
        self.left_out: list[tuple[str, str]] = []
        """(stroke, reason) of those that could not be cropped; filled while the captures are read."""
        self.series = (POSES, FORCES) if recording.counts.get(Topic.WRENCH, 0) else (POSES,)

    def captures(self, progress: Progress = unseen) -> Iterator[tuple[Row, dict[str, bytes]]]:
        """Strokes as rows of plain values, None where a value is not recorded, with their pictures by file name."""
        captures = counted(self.recording.captures(), "strokes exported", len(self.strokes), progress)
        for index, capture in enumerate(captures):
            stroke = capture.stroke
            try:
                values, pictures = ({}, {"image": capture.still_png}) if self._crop is None else self._crop(capture)
            except (CaptureRefused, SessionDamaged) as error:
                self.left_out.append((stroke.stroke_id, error.what))
                continue
            files = {name: _file_name(index, stroke.stroke_id, name, data) for name, data in pictures.items()}
            columns = {"file" if name == "image" else f"{name}_file": file for name, file in files.items()}
            row = self.row(index, stroke) | {"marked_bad": capture.bad} | values | columns
            yield row, {files[name]: data for name, data in pictures.items()}

    def row(self, index: int, stroke: Stroke) -> Row:
        """Every value of a stroke that does not need its photograph."""
        header, wait = self.recording.header, stroke.dip_to_touch_s
        return {
            "episode_index": index,
            "file": "",
            "stroke_id": stroke.stroke_id,
            "session_id": header.session_id,
            "source": str(header.source),
            "kind": stroke.kind,
            "depth_mm": stroke.depth_mm,
            "reached_mm": stroke.reached_mm,
            "tilt_deg": stroke.tilt_deg,
            "dip_to_touch_s": wait,
            "dip_to_touch_unlike": None if wait is None else float(stroke.stroke_id in self._odd),
            "heading_deg": stroke.heading_deg,
            **pair("anchor_{}_mm", stroke.anchor_mm),
            **pair("anchor_{}_px", stroke.anchor_px),
            **pair("px_per_mm_{}", stroke.px_per_mm),
            **dict(zip(PATCH_COLUMNS, stroke.cell_mm or (None,) * len(PATCH_COLUMNS), strict=True)),
            "quality": self.quality.get(stroke.stroke_id, ""),
            "marked_bad": "",
            "licence": header.licence,
            **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
        }

    def samples(self, series: Series) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """(n, 5) `SAMPLE_COLUMNS` and (n, w) values of the messages during presses, in the order of the recording.

        Raises `SessionDamaged`.
        """
        import numpy as np

        numbers = {name: number for number, name in enumerate(self.strokes)}
        when: list[tuple[int, ...]] = []
        values: list[tuple[float, ...]] = []
        current, frame, on = -1, 0, series.topic
        try:
            for _schema, channel, message in self.recording.messages(Topic.STEP, series.topic):
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
            raise SessionDamaged(self.recording.path, f"a message on {on} does not fit its schema") from None
        return np.array(when, np.int64).reshape(-1, 5), np.array(values, np.float64).reshape(-1, len(series.columns))

    def sample_columns(self, series: Series) -> Table:
        """The table of `samples`. Raises `SessionDamaged`."""
        when, values = self.samples(series)
        columns = (*when.T.tolist(), *values.T.tolist())
        return dict(zip((*SAMPLE_COLUMNS, *series.columns), columns, strict=True))


def pair(column: str, values: tuple[float, float] | None) -> Row:
    """Two columns, `{}` in whose name stands for x and y."""
    return dict(zip((column.format("x"), column.format("y")), values or (None, None), strict=True))


def _file_name(index: int, stroke_id: str, picture: str, data: bytes) -> str:
    """A readable path, safe on any file system and distinct whatever the strokes are called."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke_id)[:80]
    return f"{picture}s/{index:04d}-{safe}.{'png' if data.startswith(PNG_START) else 'jpg'}"


def export(
    source: Path,
    out: Path,
    kind: str,
    progress: Progress = unseen,
    *,
    crops: bool = False,
    calibration: Path | None = None,
) -> list[tuple[str, str]]:
    """Export a session into the new or empty folder `out` as `csv`, `npz` or `parquet`.

    With `crops`, every photograph is replaced by a crop and its mask, by this calibration or the one in use. Returns
    (stroke, reason) of the strokes that could not be cropped. Raises `InputError` for an unknown format, a folder that
    is not empty, or a session of which no stroke can be cropped, `SessionDamaged` for a recording that cannot be read;
    nothing is left behind then.
    """
    if (write := WRITERS.get(kind)) is None:
        raise InputError("--format", f"{kind!r}, allowed: {', '.join(WRITERS)}")
    if calibration is not None and not crops:
        raise InputError("--calibration", "needs --crops")
    recording = Recording(source)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever overwritten")
    if recording.counts[Topic.STROKE] == 0:
        raise InputError(recording.path, "holds no strokes to export")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        exported = Export(recording, cropper_of(recording, calibration) if crops else None)
        with staged_folder(out) as stage:
            _write_strokes(exported, stage, write, progress)
            for series in exported.series:
                write(stage / f"{series.name}s", exported.sample_columns(series))
            origin = {"file": recording.path.name, "sha256": recording.sha256}
            header = recording.header.model_dump(mode="json") | {"exported_from": origin}
            (stage / "header.json").write_text(json.dumps(header, indent=2, ensure_ascii=False) + "\n", "utf-8")
            if len(exported.left_out) == len(exported.strokes):
                stroke_id, reason = exported.left_out[0]
                raise InputError(recording.path, f"holds no stroke that can be cropped: {stroke_id} {reason}")
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    return exported.left_out


def cropper_of(recording: Recording, path: Path | None) -> Callable[[Capture], Cropped]:
    """Make what crops a recording's captures, by the calibration given, else by the one in use.

    A crop is rectified, at 20 px/mm, with its mask. Raises `CalibrationError` where a session was not calibrated; an
    import needs no calibration.
    """
    # Photographs are exported without the libraries that crops need.
    from brushloop.calibrate.presses import crop
    from brushloop.calibrate.session import calibration_of
    from brushloop.calibrate.stroke.params import PX_PER_MM

    calibration = calibration_of(recording, next(recording.stroke_records()), recording.sha256, path)

    def cropped(capture: Capture) -> Cropped:
        raster, ink, prepared = crop(capture, calibration)
        values = {"flags": "; ".join(prepared.flags), **pair("px_per_mm_{}", (PX_PER_MM, PX_PER_MM))}
        pictures = {"image": encode_png(raster), "mask": encode_png(ink.astype("uint8") * 255)}
        return values | pair("anchor_{}_px", prepared.anchor_px), pictures

    return cropped


def _write_strokes(export: Export, folder: Path, write: TableWriter, progress: Progress) -> None:
    """Write the pictures, and the table of strokes."""
    rows: list[Row] = []
    for row, pictures in export.captures(progress):
        for name, data in pictures.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_bytes(data)
        rows.append(row)
    columns = dict.fromkeys(name for row in rows for name in row)
    write(folder / "strokes", {name: [row.get(name) for row in rows] for name in columns})


def _write_csv(path: Path, table: Table) -> None:
    text = csv_text(list(table), zip(*table.values(), strict=True), "\r\n")
    path.with_suffix(".csv").write_bytes(text.encode())


def _write_npz(path: Path, table: Table) -> None:
    import numpy as np

    with zipfile.ZipFile(path.with_suffix(".npz"), "x", zipfile.ZIP_DEFLATED) as archive:
        for name, values in table.items():
            texts = name in TEXTS
            array = np.array([value or "" for value in values] if texts else values, np.str_ if texts else None)
            if array.dtype == object:
                array = array.astype(np.float64)  # in which None is NaN
            # Members opened by name carry no time, so that equal tables make equal files.
            with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                np.lib.format.write_array(out, array, allow_pickle=False)


def _write_parquet(path: Path, table: Table) -> None:
    try:
        pa: Any = importlib.import_module("pyarrow")  # without type stubs
        pq: Any = importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise InputError("--format", "parquet needs pyarrow: pip install pyarrow") from None
    pq.write_table(pa.table(table), path.with_suffix(".parquet"))


WRITERS: dict[str, TableWriter] = {"csv": _write_csv, "npz": _write_npz, "parquet": _write_parquet}
"""How each format writes a table."""
