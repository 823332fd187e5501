"""Foxglove messages from plain values, and back."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError

from brushloop.sessions.errors import SessionDamaged

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_IMAGE_BYTES = 256 * 1024 * 1024
MAX_IMAGE_PIXELS = 200_000_000
MAX_JPEG_SCANS = 100
MAX_SCANNED_PIXELS = 4_000_000_000
"""Limit of pixels times scans: each scan of a progressive JPEG covers the whole image, at about 1 ns a pixel."""
PNG_START, PNG_CHUNKS = b"\x89PNG\r\n\x1a\n", (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
EXIF = b"Exif\0\0"
JPEG_START = b"\xff\xd8"
_MARKER = re.compile(rb"\xff+([^\x00\x01\xd0-\xd8\xff])")
"""Marker that begins a segment or ends the file; within a scan 0xFF is followed only by 0 or a restart marker."""


@dataclass(frozen=True, slots=True)
class Transform:
    """Transform from a child frame's coordinates to its parent's."""

    parent: str
    child: str
    translation_mm: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    """x, y, z, w."""


def pose_message(
    t_ns: int, position_mm: tuple[float, float, float], quaternion: tuple[float, float, float, float]
) -> PoseInFrame:
    """A pose in the robot's base frame; metres on disk, as viewers expect."""
    message = PoseInFrame(frame_id="base")
    message.timestamp.FromNanoseconds(t_ns)
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = (v / 1e3 for v in position_mm)
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion
    return message


def image_message(t_ns: int, encoded: bytes, kind: str = "png") -> CompressedImage:
    """Message with an encoded image."""
    message = CompressedImage(frame_id="camera", data=encoded, format=kind)
    message.timestamp.FromNanoseconds(t_ns)
    return message


def joints_message(t_ns: int, names: Sequence[str], positions_rad: Sequence[float]) -> JointStates:
    """Positions of the arm's joints, in order. Raises `ValueError` where the lengths differ."""
    message = JointStates()
    message.timestamp.FromNanoseconds(t_ns)
    for name, position in zip(names, positions_rad, strict=True):
        message.joints.add(name=name, position=position)
    return message


def transforms_message(t_ns: int, transforms: Iterable[Transform]) -> FrameTransforms:
    """Transforms between frames; metres on disk."""
    message = FrameTransforms()
    for transform in transforms:
        added = message.transforms.add(parent_frame_id=transform.parent, child_frame_id=transform.child)
        added.timestamp.FromNanoseconds(t_ns)
        there, turned = added.translation, added.rotation
        there.x, there.y, there.z = (v / 1e3 for v in transform.translation_mm)
        turned.x, turned.y, turned.z, turned.w = transform.quaternion
    return message


def calibration_message(
    t_ns: int,
    size_px: tuple[int, int],
    camera_matrix: Sequence[Sequence[float]],
    distortion: Sequence[float],
) -> CameraCalibration:
    """Intrinsics of a single, unrectified camera: R is the identity, P is [K | 0].

    `camera_matrix` is K, 3 x 3 in pixels; `distortion` is k1, k2, p1, p2, k3. Raises `ValueError`.
    """
    rows = [list(map(float, row)) for row in camera_matrix]
    if [len(row) for row in rows] != [3, 3, 3]:
        raise ValueError(f"a camera matrix is 3 x 3, got rows of {[len(row) for row in rows]}")
    message = CameraCalibration(
        frame_id="camera",
        width=size_px[0],
        height=size_px[1],
        distortion_model="plumb_bob",
        D=distortion,
        K=[v for row in rows for v in row],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[v for row in rows for v in [*row, 0.0]],
    )
    message.timestamp.FromNanoseconds(t_ns)
    return message


def log_message(t_ns: int, text: str, *, warning: bool = False) -> Log:
    """Log line for the operator and later readers of the file."""
    message = Log(level=Log.WARNING if warning else Log.INFO, message=text, name="brushloop")
    message.timestamp.FromNanoseconds(t_ns)
    return message


def decode_still(data: bytes, where: Path | str) -> bytes:
    """Encoded image of a message on an image topic. Raises `SessionDamaged`."""
    try:
        return CompressedImage.FromString(data).data
    except DecodeError:
        raise SessionDamaged(where, "a photograph does not fit its schema") from None


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Lossless PNG at cv2's default strategy; setting a compression level makes it twice as slow."""
    import cv2

    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def decode_gray(data: bytes, where: str) -> NDArray[np.uint8]:
    """Decode to (h, w) uint8 gray, turned as the orientation in a JPEG says, so that pixels count as viewers show them.

    Raises `SessionDamaged` for other formats, and for cut or absurdly large images.
    """
    import cv2

    if len(data) > MAX_IMAGE_BYTES:
        raise SessionDamaged(where, f"image of {len(data)} bytes exceeds {MAX_IMAGE_BYTES}")
    # Checked before decoding: a PNG of one megabyte can unpack to a gigabyte of pixels.
    data = _pixels_of_png(data) if data.startswith(PNG_START) else data
    size = _png_size(data) or _jpeg_size(data)
    if size is None:
        raise SessionDamaged(where, "is not a complete PNG or JPEG image")
    width, height, scans = size
    if width * height > MAX_IMAGE_PIXELS:
        raise SessionDamaged(where, f"image of {width} x {height} pixels exceeds {MAX_IMAGE_PIXELS}")
    # An empty scan takes ten bytes, so a small file could take minutes to decode.
    most = min(MAX_JPEG_SCANS, MAX_SCANNED_PIXELS // max(width * height, 1))
    if scans > most:
        raise SessionDamaged(where, f"JPEG of {width} x {height} pixels in more than {most} scans")
    image = _decoded(data, cv2.IMREAD_GRAYSCALE, where)
    if image is None or image.size == 0:
        raise SessionDamaged(where, "cannot decode the image")
    return image


def upright(data: bytes, image: NDArray[np.uint8]) -> bytes:
    """The photograph itself, or `image`, what `decode_gray` made of it, as PNG, where a JPEG says that it is turned.

    Readers differ in whether they turn a picture: without the mark every reader sees the same pixels, and a point
    measured in a viewer lies where it was measured.
    """
    import cv2
    import numpy as np

    if EXIF not in data or data.startswith(PNG_START):
        return data
    stored = _decoded(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION, "")
    return data if stored is not None and np.array_equal(stored, image) else encode_png(image)


def _decoded(data: bytes, flags: int, where: str) -> NDArray[np.uint8] | None:
    import cv2
    import numpy as np

    try:
        return cast("NDArray[np.uint8] | None", cv2.imdecode(np.frombuffer(data, np.uint8), flags))
    except cv2.error as error:
        if error.code == cv2.Error.StsNoMem:
            raise MemoryError from None
        raise SessionDamaged(where, f"cannot decode the image: {error.err}") from None


def _pixels_of_png(data: bytes) -> bytes:
    """Only the chunks that make the picture; empty where a chunk fails its CRC or the end is missing.

    libpng prints to stderr what it finds in the others, such as the name of a colour profile.
    """
    pieces, at = [PNG_START], len(PNG_START)
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        name, end = data[at + 4 : at + 8], at + 12 + length
        if data[end - 4 : end] != zlib.crc32(memoryview(data)[at + 4 : end - 4]).to_bytes(4, "big"):
            return b""
        if name in PNG_CHUNKS:
            pieces.append(data[at:end])
        if name == PNG_CHUNKS[-1]:
            return b"".join(pieces)
        at = end
    return b""


def _png_size(data: bytes) -> tuple[int, int, int] | None:
    """Width, height and 1 scan, from the header."""
    return (*struct.unpack_from(">II", data, 16), 1) if data[12:16] == PNG_CHUNKS[0] and len(data) >= 33 else None


def _jpeg_size(data: bytes) -> tuple[int, int, int] | None:
    """Width, height and number of scans, counted up to the limit; None for a file without an end mark."""
    size, scans, at = None, 0, len(JPEG_START)
    while data.startswith(JPEG_START) and (found := _MARKER.search(data, at)) and scans <= MAX_JPEG_SCANS:
        marker, at = found[1][0], found.end()
        if marker == 0xD9:  # end of the image; a thumbnail's lies inside a segment
            break
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and len(data) >= at + 7:
            size = struct.unpack_from(">HH", data, at + 3)
        scans += marker == 0xDA
        at += int.from_bytes(data[at : at + 2], "big")
    else:
        # cv2 would pad the rest of a cut photograph with gray.
        size = size if scans > MAX_JPEG_SCANS else None
    return (size[1], size[0], scans) if size is not None else None
