"""Rows of an export: one per stroke with its pictures, one per pose of the brush tip, one per sample of force."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.history import WAIT, unlike
from brushloop.sessions.messages import PNG_START
from brushloop.sessions.progress import Progress, counted, unseen
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Quality, StepEvent, Stroke, Topic, Wrench

TEXT_COLUMNS = ("stroke_id", "file", "session_id", "source", "kind", "quality", "marked_bad", "licence")
CROP_TEXT_COLUMNS = ("mask_file", "flags")
"""Texts of a stroke that only exports of crops have; with whole frames also `frame_file`."""
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Crop:
    """The surroundings of a stroke as seen straight from above, at the same scale for every stroke."""

    image_png: bytes
    """Gray, not corrected for the light."""
    mask_png: bytes
    """255 where the stroke's ink is, else 0; as large as the image."""
    px_per_mm: float
    anchor_px: tuple[float, float] | None
    """Zero-touch point on the crop; pixel j covers [j, j + 1)."""
    flags: str
    """Defects of the capture, separated by `; `."""


Cropper = Callable[[Capture], Crop | str]
"""Crops a capture, or says why it cannot be cropped."""


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
class ForceRow:
    """Sample of the force sensor at one moment of a stroke's press; the first five fields as in `PoseRow`."""

    episode_index: int
    frame_index: int
    t_ns: int
    log_ns: int
    sequence: int
    wrench: tuple[float, float, float, float, float, float]
    """Force in N and torque in N m, in the sensor's frame: fx, fy, fz, mx, my, mz."""


@dataclass(frozen=True, slots=True)
class Export:
    """Recording to export, and the rows from which every format is written."""

    recording: Recording
    numbers: dict[str, int]
    """Number of each stroke, in the order of the table of strokes."""
    odd: frozenset[str] = frozenset()
    """Strokes whose wait between dip and touch differs from the others'."""
    quality: dict[str, str] = field(default_factory=dict[str, str])
    """`passed`, or `failed: ` and the checks that failed, of every stroke that was judged."""
    progress: Progress = unseen
    cropper: Cropper | None = None
    """Replaces every photograph by a crop and its mask."""
    frames: bool = False
    """Also give the whole photograph, where there is a cropper."""
    left_out: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(stroke, reason) of those that could not be cropped; filled while the captures are read."""

    @classmethod
    def of(
        cls, recording: Recording, progress: Progress = unseen, cropper: Cropper | None = None, *, frames: bool = False
    ) -> Export:
        """Prepare the export of a recording. Raises `SessionDamaged` where a stroke appears twice."""
        numbers: dict[str, int] = {}
        waits: dict[str, float] = {}
        for number, stroke in enumerate(recording.stroke_records()):
            if numbers.setdefault(stroke.stroke_id, number) != number:
                raise SessionDamaged(recording.path, f"holds stroke {stroke.stroke_id} twice")
            if stroke.dip_to_touch_s is not None:
                waits[stroke.stroke_id] = stroke.dip_to_touch_s
        odd = frozenset(unlike(waits))
        return cls(recording, numbers, odd, _qualities(recording), progress, cropper, frames)

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the pictures that each stroke has."""
        if self.cropper is None:
            return ("image",)
        return ("image", "mask", "frame") if self.frames else ("image", "mask")

    @property
    def text_columns(self) -> tuple[str, ...]:
        """Names of the columns of text."""
        more = CROP_TEXT_COLUMNS if self.cropper else ()
        return (*TEXT_COLUMNS, *more, *(("frame_file",) if "frame" in self.pictures else ()))

    def captures(self) -> Iterator[tuple[Row, dict[str, bytes]]]:
        """Strokes as rows of plain values, None where a value is not recorded, with their encoded pictures by name."""
        captures = counted(self.recording.captures(), "strokes exported", len(self.numbers), self.progress)
        for index, capture in enumerate(captures):
            row = self.row(index, capture.stroke) | {"marked_bad": capture.bad}
            name, suffix = _file_name(index, capture.stroke.stroke_id), _suffix(capture.still_png)
            if self.cropper is None:
                yield row | {"file": f"images/{name}.{suffix}"}, {"image": capture.still_png}
                continue
            crop = self.cropper(capture)
            if isinstance(crop, str):
                self.left_out.append((capture.stroke.stroke_id, crop))
                continue
            scale = (crop.px_per_mm, crop.px_per_mm)
            row |= {**_pair("anchor", "px", crop.anchor_px), **_pair("px_per_mm", "", scale), "flags": crop.flags}
            row |= {"file": f"images/{name}.png", "mask_file": f"masks/{name}.png"}
            pictures = {"image": crop.image_png, "mask": crop.mask_png}
            if self.frames:
                row["frame_file"], pictures["frame"] = f"frames/{name}.{suffix}", capture.still_png
            yield row, pictures

    def poses(self) -> Iterator[PoseRow]:
        """Poses of each stroke's press, in the order of the recording. Raises `SessionDamaged`."""
        for episode, frame, t_ns, log_ns, number, data in self._samples(Topic.TCP):
            try:
                pose = PoseInFrame.FromString(data).pose
            except DecodeError:
                raise self._damaged(Topic.TCP) from None
            at, turned = pose.position, pose.orientation
            position = (at.x * 1e3, at.y * 1e3, at.z * 1e3)
            quaternion = (turned.x, turned.y, turned.z, turned.w)
            yield PoseRow(episode, frame, t_ns, log_ns, number, position, quaternion)

    def forces(self) -> Iterator[ForceRow]:
        """Force during each stroke's press, in the order of the recording. Raises `SessionDamaged`."""
        for episode, frame, t_ns, log_ns, number, data in self._samples(Topic.WRENCH):
            try:
                one = Wrench.model_validate_json(data)
            except ValidationError:
                raise self._damaged(Topic.WRENCH) from None
            wrench = (one.fx_n, one.fy_n, one.fz_n, one.mx_nm, one.my_nm, one.mz_nm)
            yield ForceRow(episode, frame, t_ns, log_ns, number, wrench)

    @property
    def has_force(self) -> bool:
        """Whether the rig had a force sensor."""
        return self.recording.counts.get(Topic.WRENCH, 0) > 0

    def _samples(self, topic: Topic) -> Iterator[tuple[int, int, int, int, int, bytes]]:
        """(episode, frame, t_ns, log_ns, sequence, data) of a topic's messages during presses."""
        current, frame = -1, 0
        for _schema, channel, message in self.recording.messages(Topic.STEP, topic):
            if channel.topic == Topic.STEP:
                try:
                    event = StepEvent.model_validate_json(message.data)
                except ValidationError:
                    raise self._damaged(Topic.STEP) from None
                pressed = event.phase == "begin" and event.kind != "capture"
                current, frame = self.numbers.get(str(event.params.get("stroke_id")), -1) if pressed else -1, 0
            elif current >= 0:
                yield current, frame, message.publish_time, message.log_time, message.sequence, message.data
                frame += 1

    def _damaged(self, topic: Topic) -> SessionDamaged:
        return SessionDamaged(self.recording.path, f"a message on {topic} does not fit its schema")

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

    def row(self, index: int, stroke: Stroke) -> Row:
        """Every value of a stroke that does not need its photograph."""
        header = self.recording.header
        patch = stroke.cell_mm or (None, None, None, None)
        return {
            "episode_index": index,
            "file": "",
            "stroke_id": stroke.stroke_id,
            "session_id": header.session_id,
            "source": str(header.source),
            "kind": stroke.kind,
            "depth_mm": stroke.depth_mm,
            "tilt_deg": stroke.tilt_deg,
            **self._wait(stroke),
            "heading_deg": stroke.heading_deg,
            **_pair("anchor", "mm", stroke.anchor_mm),
            **_pair("anchor", "px", stroke.anchor_px),
            **_pair("px_per_mm", "", stroke.px_per_mm),
            "cell_x_mm": patch[0],
            "cell_y_mm": patch[1],
            "cell_width_mm": patch[2],
            "cell_depth_mm": patch[3],
            "quality": self.quality.get(stroke.stroke_id, ""),
            "marked_bad": "",
            "licence": header.licence,
            **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
        }


def _suffix(still: bytes) -> str:
    return "png" if still.startswith(PNG_START) else "jpg"


def _qualities(recording: Recording) -> dict[str, str]:
    """Result of each stroke's quality checks; the last one counts."""
    found: dict[str, str] = {}
    for _schema, _channel, message in recording.messages(Topic.QUALITY):
        try:
            judged = Quality.model_validate_json(message.data)
        except ValidationError:
            raise SessionDamaged(recording.path, f"a message on {Topic.QUALITY} does not fit its schema") from None
        failed = ", ".join(check.name for check in judged.checks if not check.passed)
        found[judged.stroke_id] = f"failed: {failed}" if failed else "passed"
    return found


def _pair(stem: str, unit: str, values: tuple[float, float] | None) -> Row:
    first, second = values or (None, None)
    end = f"_{unit}" if unit else ""
    return {f"{stem}_x{end}": first, f"{stem}_y{end}": second}


def _file_name(index: int, stroke_id: str) -> str:
    """A readable name without a suffix, safe on any file system and distinct whatever the strokes are called."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke_id)[:80]
    return f"{index:04d}-{safe}"
