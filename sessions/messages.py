"""Foxglove messages from plain values, and back."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING, cast

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

from sessions.errors import SessionDamaged

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_IMAGE_BYTES = 256 * 1024 * 1024
MAX_IMAGE_PIXELS = 200_000_000
PNG_START, PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"


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
    """An encoded image as it will be shown."""
    message = CompressedImage(frame_id="camera", data=encoded, format=kind)
    message.timestamp.FromNanoseconds(t_ns)
    return message


def log_message(t_ns: int, text: str, *, warning: bool = False) -> Log:
    """A line for the operator and for whoever reads the file later."""
    message = Log(level=Log.WARNING if warning else Log.INFO, message=text, name="brushloop")
    message.timestamp.FromNanoseconds(t_ns)
    return message


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Lossless PNG at cv2's default strategy: naming a level makes it twice as slow."""
    import cv2

    ok, data = cv2.imencode(".png", image)
    if not ok:
        raise ValueError(f"cannot encode an image of shape {image.shape} and type {image.dtype}")
    return data.tobytes()


def decode_gray(data: bytes, where: str) -> NDArray[np.uint8]:
    """(h, w) uint8 gray. Raises `SessionDamaged` for what is no PNG or JPEG, is cut short or is absurdly large."""
    import cv2
    import numpy as np

    if len(data) > MAX_IMAGE_BYTES:
        raise SessionDamaged(where, f"image of {len(data)} bytes exceeds {MAX_IMAGE_BYTES}")
    # Before decoding: a megabyte of PNG can state, and would be given, a gigabyte of pixels.
    size = _png_size(data) or _jpeg_size(data)
    if size is None:
        raise SessionDamaged(where, "is no whole PNG or JPEG image")
    if size[0] * size[1] > MAX_IMAGE_PIXELS:
        raise SessionDamaged(where, f"image of {size[0]} x {size[1]} pixels exceeds {MAX_IMAGE_PIXELS}")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise SessionDamaged(where, f"cannot decode the image: {error.err}") from None
    if image is None or image.size == 0:  # pyright: ignore[reportUnnecessaryComparison]
        raise SessionDamaged(where, "cannot decode the image")
    return cast("NDArray[np.uint8]", image)


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Size from the header chunk; None where a chunk fails its CRC: libpng would say so on our stderr."""
    at = len(PNG_START)
    while data.startswith(PNG_START) and data[12:16] == b"IHDR" and at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        name, crc_at = data[at + 4 : at + 8], at + 8 + length
        if data[crc_at : crc_at + 4] != zlib.crc32(memoryview(data)[at + 4 : crc_at]).to_bytes(4, "big"):
            return None
        if name == PNG_END:
            width, height = struct.unpack_from(">II", data, 16)
            return width, height
        at = crc_at + 4
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Size from the start-of-frame segment; None for a file that ends before its end mark."""
    at = len(JPEG_START)
    while data.startswith(JPEG_START) and at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 5)
            # An end mark before the frame is a thumbnail's; cv2 would pad the rest of a cut photograph with gray.
            return (width, height) if data.find(JPEG_END, at) >= 0 else None
        filler = marker == 0xFF
        at += 1 if filler else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
