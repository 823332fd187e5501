"""Rows of an export: one per stroke with its pictures, one per pose of the brush tip, one per sample of force."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError
from pydantic import ValidationError

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.history import WAIT, unlike
from brushloop.sessions.messages import PNG_START
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Quality, StepEvent, Stroke, Topic, Wrench
from brushloop.sessions.terminal import Progress, counted

TEXT_COLUMNS = ("stroke_id", "file", "session_id", "source", "kind", "quality", "marked_bad", "licence")
CROP_TEXT_COLUMNS = ("mask_file", "flags")
"""Texts of a stroke that only exports of crops have; with whole frames also `frame_file`."""
PATCH_COLUMNS = ("cell_x_mm", "cell_y_mm", "cell_width_mm", "cell_height_mm")
SAMPLE_COLUMNS = ("episode_index", "frame_index", "t_ns", "log_ns", "sequence")
"""Numbers of the stroke and of the sample within it; times at the device and the recorder; the sample's own number."""
POSE_COLUMNS = ("x_mm", "y_mm", "z_mm", "qx", "qy", "qz", "qw")
"""Of the brush tip, in the robot's base frame."""
FORCE_COLUMNS = ("fx_n", "fy_n", "fz_n", "mx_nm", "my_nm", "mz_nm")
"""In the sensor's own frame."""
Row = dict[str, Any]
Sample = tuple[tuple[int, ...], tuple[float, ...]]
"""Values of `SAMPLE_COLUMNS`, then of `POSE_COLUMNS` or `FORCE_COLUMNS`."""


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


class Export:
    """The rows from which every format is written: strokes with their pictures, poses, and forces."""

    def __init__(self, recording: Recording, progress: Progress, cropper: Cropper | None, frames: bool) -> None:
        """Raises `SessionDamaged` where a stroke appears twice."""
        self.recording = recording
        self._progress = progress
        self.cropper = cropper
        self.strokes: dict[str, Stroke] = {}
        for stroke in recording.stroke_records():
            if self.strokes.setdefault(stroke.stroke_id, stroke) is not stroke:
                raise SessionDamaged(recording.path, f"holds stroke {stroke.stroke_id} twice")
        waits = {name: wait for name, stroke in self.strokes.items() if (wait := stroke.dip_to_touch_s) is not None}
        self._odd = frozenset(unlike(waits))
        self.quality = self._judged()
        """`passed`, or `failed: ...`, by the name of each stroke that was judged."""
        self.left_out: list[tuple[str, str]] = []
        """(stroke, reason) of those that could not be cropped; filled while the captures are read."""
        self.pictures = ("image",) if cropper is None else ("image", "mask", "frame") if frames else ("image", "mask")
        """Names of the pictures that each stroke has."""
        more = (*CROP_TEXT_COLUMNS, "frame_file")[: len(self.pictures)] if cropper else ()
        self.text_columns = (*TEXT_COLUMNS, *more)
        self.has_force = recording.counts.get(Topic.WRENCH, 0) > 0

    def captures(self) -> Iterator[tuple[Row, dict[str, bytes]]]:
        """Strokes as rows of plain values, None where a value is not recorded, with their encoded pictures by name."""
        captures = counted(self.recording.captures(), "strokes exported", len(self.strokes), self._progress)
        for index, capture in enumerate(captures):
            row = self.row(index, capture.stroke) | {"marked_bad": capture.bad}
            name = _file_name(index, capture.stroke.stroke_id)
            suffix = "png" if capture.still_png.startswith(PNG_START) else "jpg"
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
            if "frame" in self.pictures:
                row["frame_file"], pictures["frame"] = f"frames/{name}.{suffix}", capture.still_png
            yield row, pictures

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
            WAIT: wait,
            "dip_to_touch_unlike": None if wait is None else float(stroke.stroke_id in self._odd),
            "heading_deg": stroke.heading_deg,
            **_pair("anchor", "mm", stroke.anchor_mm),
            **_pair("anchor", "px", stroke.anchor_px),
            **_pair("px_per_mm", "", stroke.px_per_mm),
            **dict(zip(PATCH_COLUMNS, stroke.cell_mm or (None,) * len(PATCH_COLUMNS), strict=True)),
            "quality": self.quality.get(stroke.stroke_id, ""),
            "marked_bad": "",
            "licence": header.licence,
            **{f"commanded_{name}": value for name, value in stroke.commanded.items()},
        }

    def number_columns(self) -> list[str]:
        """Names of the numeric columns that any stroke has."""
        names = dict.fromkeys(name for stroke in self.strokes.values() for name in self.row(0, stroke))
        return [name for name in names if name not in self.text_columns]

    def poses(self) -> Iterator[Sample]:
        """Poses of each stroke's press, in the order of the recording. Raises `SessionDamaged`."""

        def values(data: bytes) -> tuple[float, ...]:
            pose = PoseInFrame.FromString(data).pose
            at, turned = pose.position, pose.orientation
            return at.x * 1e3, at.y * 1e3, at.z * 1e3, turned.x, turned.y, turned.z, turned.w

        return self._samples(Topic.TCP, values)

    def forces(self) -> Iterator[Sample]:
        """Force during each stroke's press, in the order of the recording. Raises `SessionDamaged`."""

        def values(data: bytes) -> tuple[float, ...]:
            wrench = Wrench.model_validate_json(data)
            return wrench.fx_n, wrench.fy_n, wrench.fz_n, wrench.mx_nm, wrench.my_nm, wrench.mz_nm

        return self._samples(Topic.WRENCH, values)

    def header_json(self) -> bytes:
        """Header of the recording as JSON, with the digest of the file."""
        header = self.recording.header.model_dump(mode="json")
        origin = {"file": self.recording.path.name, "sha256": self.recording.sha256}
        return (json.dumps({**header, "exported_from": origin}, indent=2, ensure_ascii=False) + "\n").encode()

    def _samples(self, topic: Topic, values: Callable[[bytes], tuple[float, ...]]) -> Iterator[Sample]:
        """A topic's messages during presses."""
        numbers = {name: number for number, name in enumerate(self.strokes)}
        current, frame, on = -1, 0, topic
        try:
            for _schema, channel, message in self.recording.messages(Topic.STEP, topic):
                on = channel.topic
                if on == Topic.STEP:
                    event = StepEvent.model_validate_json(message.data)
                    pressed = event.phase == "begin" and event.kind != "capture"
                    current, frame = numbers.get(str(event.params.get("stroke_id")), -1) if pressed else -1, 0
                elif current >= 0:
                    times = (message.publish_time, message.log_time, message.sequence)
                    yield (current, frame, *times), values(message.data)
                    frame += 1
        except (ValidationError, DecodeError):
            raise self._unfit(on) from None

    def _unfit(self, topic: str) -> SessionDamaged:
        return SessionDamaged(self.recording.path, f"a message on {topic} does not fit its schema")

    def _judged(self) -> dict[str, str]:
        """`passed`, or `failed: ` and the checks that failed, of every stroke that was judged; the last one counts."""
        results: dict[str, str] = {}
        for _schema, _channel, message in self.recording.messages(Topic.QUALITY):
            try:
                judged = Quality.model_validate_json(message.data)
            except ValidationError:
                raise self._unfit(Topic.QUALITY) from None
            failed = ", ".join(check.name for check in judged.checks if not check.passed)
            results[judged.stroke_id] = f"failed: {failed}" if failed else "passed"
        return results


def _pair(stem: str, unit: str, values: tuple[float, float] | None) -> Row:
    first, second = values or (None, None)
    end = f"_{unit}" if unit else ""
    return {f"{stem}_x{end}": first, f"{stem}_y{end}": second}


def file_column(picture: str) -> str:
    """Name of the column that names a picture's file."""
    return "file" if picture == "image" else f"{picture}_file"


def _file_name(index: int, stroke_id: str) -> str:
    """A readable name without a suffix, safe on any file system and distinct whatever the strokes are called."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in stroke_id)[:80]
    return f"{index:04d}-{safe}"
