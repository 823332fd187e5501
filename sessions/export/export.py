"""A recording for other tools: images with a table, NumPy arrays, or Parquet that Hugging Face `datasets` loads.

Every export is a folder, written beside its place and renamed when it is whole; nothing is written into a folder
that holds anything. The images are the photographs as they were recorded, byte for byte.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from sessions.disk import check_room
from sessions.errors import InputError, SessionDamaged, disk_error
from sessions.journal.journal import fsync_folder
from sessions.reader import Capture, Recording
from sessions.recording import container
from sessions.recording.messages import PNG_START
from sessions.recording.schemas import StepEvent, Stroke, Topic
from sessions.waits import WAIT, unlike

FORMATS = ("png", "npz", "parquet")
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PoseRow:
    """The brush tip at one moment of a stroke's press."""

    episode_index: int
    """Which stroke, in the order of the table of strokes."""
    frame_index: int
    """Counts from 0 within the stroke."""
    t_ns: int
    """When the host received the sample from the controller."""
    log_ns: int
    """When it was recorded."""
    sequence: int
    """The sample's own number: a gap is a sample that is missing."""
    position_mm: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """x, y, z, w."""


@dataclass(frozen=True, slots=True)
class Export:
    """What every format is written from."""

    recording: Recording
    names: dict[str, str]
    """Stroke -> file name of its image, without a suffix: nothing that a file system could refuse."""
    odd: frozenset[str] = frozenset()
    """Strokes that waited for their touch unlike the others."""

    def captures(self) -> Iterator[tuple[Row, Capture]]:
        """Each stroke as a row of plain values, None where the recording does not tell, with its photograph."""
        for index, capture in enumerate(self.recording.captures()):
            yield self._row(index, capture), capture

    def poses(self) -> Iterator[PoseRow]:
        """The poses of each stroke's press, in the order of the recording. Raises `SessionDamaged`."""
        index = {stroke_id: number for number, stroke_id in enumerate(self.names)}
        current, frame = -1, 0
        for _schema, channel, message in container.messages(self.recording.path, [Topic.STEP, Topic.TCP]):
            try:
                if channel.topic == Topic.STEP:
                    event = StepEvent.model_validate_json(message.data)
                    pressed = event.phase == "begin" and event.kind != "capture"
                    current, frame = index.get(str(event.params.get("stroke_id")), -1) if pressed else -1, 0
                    continue
                pose = PoseInFrame.FromString(message.data).pose
            except (ValidationError, DecodeError):
                what = f"a message on {channel.topic} does not fit its schema"
                raise SessionDamaged(self.recording.path, what) from None
            if current >= 0:
                at, turned = pose.position, pose.orientation
                position = (at.x * 1e3, at.y * 1e3, at.z * 1e3)
                quaternion = (turned.x, turned.y, turned.z, turned.w)
                times = (message.publish_time, message.log_time)
                yield PoseRow(current, frame, *times, message.sequence, position, quaternion)
                frame += 1

    def _wait(self, stroke: Stroke) -> Row:
        told = stroke.dip_to_touch_s is not None
        return {
            WAIT: stroke.dip_to_touch_s,
            "dip_to_touch_unlike": float(stroke.stroke_id in self.odd) if told else None,
        }

    def _row(self, index: int, capture: Capture) -> Row:
        stroke = capture.stroke
        header = self.recording.header
        cell = stroke.cell_mm or (None, None, None, None)
        suffix = "png" if capture.still_png.startswith(PNG_START) else "jpg"
        return {
            "episode_index": index,
            "file": f"images/{self.names[stroke.stroke_id]}.{suffix}",
            "stroke_id": stroke.stroke_id,
            "session_id": header.session_id,
            "source": str(header.source),
            "kind": stroke.kind,
            "height_mm": stroke.height_mm,
            "tilt_deg": stroke.tilt_deg,
            **self._wait(stroke),
            "heading_deg": stroke.heading_deg,
            **_pair("anchor", "mm", stroke.anchor_mm),
            **_pair("anchor", "px", stroke.anchor_px),
            **_pair("px_per_mm", "", stroke.px_per_mm),
            "cell_x_mm": cell[0],
            "cell_y_mm": cell[1],
            "cell_width_mm": cell[2],
            "cell_height_mm": cell[3],
            **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
        }


def _pair(stem: str, unit: str, values: tuple[float, float] | None) -> Row:
    first, second = values or (None, None)
    end = f"_{unit}" if unit else ""
    return {f"{stem}_x{end}": first, f"{stem}_y{end}": second}


def export(source: Path, out: Path, kind: str) -> Path:
    """Export into the folder `out`. Raises `InputError` for an unknown format or a folder that is not empty,

    `SessionDamaged` for a recording that cannot be read: then nothing is left behind.
    """
    write = _writer(kind)
    recording = Recording(source)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "exists and is not an empty folder; nothing is ever written over")
    if recording.strokes() == 0:
        raise InputError(recording.path, "holds no strokes to export")
    stage = out.with_name(f".{out.name}.partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        check_room(out.parent, recording.path.stat().st_size)
        shutil.rmtree(stage, ignore_errors=True)  # left by an export that was killed: a copy
        stage.mkdir()
        write(Export(recording, _file_names(recording), _odd(recording)), stage)
        for path in (stage, *(p for p in stage.rglob("*") if p.is_dir())):
            fsync_folder(path)
        stage.rename(out)  # replaces an empty folder, and no other
        fsync_folder(out.parent)
    except OSError as error:
        raise disk_error(out, "cannot write", error) from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    return out


def _writer(kind: str) -> Callable[[Export, Path], None]:
    match kind:
        case "png":
            from sessions.export.table import write_png

            return write_png
        case "npz":
            from sessions.export.table import write_npz

            return write_npz
        case "parquet":
            from sessions.export.parquet import write_parquet

            return write_parquet
        case _:
            raise InputError("--format", f"{kind!r}, allowed: {', '.join(FORMATS)}")


def _file_names(recording: Recording) -> dict[str, str]:
    """Readable, safe and different from each other, whatever the strokes are called."""
    names: dict[str, str] = {}
    for number, stroke in enumerate(recording.stroke_records()):
        if stroke.stroke_id in names:
            raise SessionDamaged(recording.path, f"holds stroke {stroke.stroke_id} twice")
        safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke.stroke_id)[:80]
        names[stroke.stroke_id] = f"{number:04d}-{safe}"
    return names


def _odd(recording: Recording) -> frozenset[str]:
    waits = {one.stroke_id: one.dip_to_touch_s for one in recording.stroke_records()}
    return frozenset(unlike({name: wait for name, wait in waits.items() if wait is not None}))


def write_durably(path: Path, data: bytes) -> None:
    """A new file, on disk before this returns. Raises `OSError`."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
