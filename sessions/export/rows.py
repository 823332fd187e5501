"""Rows of an export: one per stroke with its photograph, one per pose of the brush tip."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from sessions.errors import SessionDamaged
from sessions.history import WAIT, unlike
from sessions.progress import Progress, counted, unseen
from sessions.reader import Capture, Recording
from sessions.recording import container
from sessions.recording.messages import PNG_START
from sessions.recording.schemas import StepEvent, Stroke, Topic

TEXT_COLUMNS = ("stroke_id", "file", "session_id", "source", "kind")
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class PoseRow:
    """Pose of the brush tip at one moment of a stroke's press."""

    episode_index: int
    """Number of the stroke, in the order of the table of strokes."""
    frame_index: int
    """Counts from 0 within the stroke."""
    t_ns: int
    """When the host received the sample from the controller."""
    log_ns: int
    """When it was recorded."""
    sequence: int
    """Number of the sample: a gap means a missing sample."""
    position_mm: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """x, y, z, w."""


@dataclass(frozen=True, slots=True)
class Export:
    """Recording to export, and the rows from which every format is written."""

    recording: Recording
    names: dict[str, str]
    """File name of each stroke's image, without a suffix; safe on any file system."""
    odd: frozenset[str] = frozenset()
    """Strokes whose wait between dip and touch differs from the others'."""
    progress: Progress = unseen

    @classmethod
    def of(cls, recording: Recording, progress: Progress = unseen) -> Export:
        """Prepare the export of a recording. Raises `SessionDamaged` where a stroke appears twice."""
        strokes = list(recording.stroke_records())
        waits = {one.stroke_id: one.dip_to_touch_s for one in strokes}
        odd = frozenset(unlike({name: wait for name, wait in waits.items() if wait is not None}))
        return cls(recording, _file_names(recording.path, strokes), odd, progress)

    def captures(self) -> Iterator[tuple[Row, Capture]]:
        """Strokes as rows of plain values, None where a value is not recorded, with their photographs."""
        captures = counted(self.recording.captures(), "strokes exported", len(self.names), self.progress)
        for index, capture in enumerate(captures):
            yield self._row(index, capture), capture

    def poses(self) -> Iterator[PoseRow]:
        """Poses of each stroke's press, in the order of the recording. Raises `SessionDamaged`."""
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

    def header_json(self) -> bytes:
        """Header of the recording as JSON, with the digest of the file."""
        header = self.recording.header.model_dump(mode="json")
        origin = {"file": self.recording.path.name, "sha256": self.recording.sha256}
        return (json.dumps({**header, "exported_from": origin}, indent=2, ensure_ascii=False) + "\n").encode()

    def _wait(self, stroke: Stroke) -> Row:
        known = stroke.dip_to_touch_s is not None
        return {
            WAIT: stroke.dip_to_touch_s,
            "dip_to_touch_unlike": float(stroke.stroke_id in self.odd) if known else None,
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


def _file_names(path: Path, strokes: list[Stroke]) -> dict[str, str]:
    """Readable, safe and distinct file names, whatever the strokes are called."""
    names: dict[str, str] = {}
    for number, stroke in enumerate(strokes):
        if stroke.stroke_id in names:
            raise SessionDamaged(path, f"holds stroke {stroke.stroke_id} twice")
        safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke.stroke_id)[:80]
        names[stroke.stroke_id] = f"{number:04d}-{safe}"
    return names
