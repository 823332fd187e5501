"""Poses and photographs as Foxglove's messages, and photographs as arrays."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import TYPE_CHECKING

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.message import DecodeError

from brushloop.sessions.errors import SessionDamaged, in_one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_IMAGE_BYTES = 256 * 1024 * 1024
MAX_IMAGE_PIXELS = 80_000_000
"""Fewer than the limit above which Pillow warns."""
MAX_JPEG_SCANS = 100
"""Each scan of a progressive JPEG takes ten bytes or more of the file, and covers the whole image."""
PNG_START = b"\x89PNG\r\n\x1a\n"
PIXELS_ONLY = {b"IHDR", b"IDAT", b"IEND"}
"""Chunks of a PNG without orientation, profile or text."""


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


def decode_still(data: bytes, where: Path | str) -> bytes:
    """Encoded image of a message on an image topic. Raises `SessionDamaged`."""
    try:
        return CompressedImage.FromString(data).data
    except DecodeError:
        raise SessionDamaged(where, "the message of a photograph cannot be decoded") from None


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Lossless PNG at cv2's default strategy; setting a compression level makes it twice as slow."""
    import cv2

    return cv2.imencode(".png", image)[1].tobytes()


def _chunks(png: bytes) -> set[bytes]:
    """Names of the chunks of a PNG. Raises ValueError for a wrong CRC, struct.error where it is cut."""
    names, at, whole = set[bytes](), len(PNG_START), memoryview(png)
    while b"IEND" not in names:
        length, name = struct.unpack_from(">I4s", png, at)
        if struct.unpack_from(">I", png, at + 8 + length)[0] != zlib.crc32(whole[at + 4 : at + 8 + length]):
            raise ValueError("a chunk does not match its CRC")
        names.add(name)
        at += 12 + length
    return names


def decode_gray(data: bytes, where: str) -> NDArray[np.uint8]:
    """Decode a PNG or JPEG to (h, w) uint8 gray, turned as its orientation says, so that pixels count as viewers show.

    Raises `SessionDamaged` for other formats, and for cut or absurdly large images.
    """
    import cv2
    import numpy as np
    from PIL import Image, ImageOps

    if len(data) > MAX_IMAGE_BYTES:
        raise SessionDamaged(where, f"image of {len(data)} bytes exceeds {MAX_IMAGE_BYTES}")
    if not data.startswith(PNG_START) and data.count(b"\xff\xda") > MAX_JPEG_SCANS:
        raise SessionDamaged(where, f"JPEG image in more than {MAX_JPEG_SCANS} scans")
    try:
        plain = data.startswith(PNG_START) and _chunks(data) == PIXELS_ONLY
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                what = f"image of {image.width} x {image.height} pixels exceeds {MAX_IMAGE_PIXELS}"
                raise SessionDamaged(where, what)
            if image.mode == "L" and plain:
                # OpenCV lets other threads decode meanwhile. It refuses some damaged images that Pillow reads, and says
                # on stderr what stands in a profile.
                gray = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
                if gray is not None:
                    return gray.astype(np.uint8, copy=False)
            image.draft("L", image.size)
            ImageOps.exif_transpose(image, in_place=True)
            if image.mode.startswith("I"):
                return (np.asarray(image) >> 8).astype(np.uint8)  # 16 bits
            return np.asarray(image if image.mode == "L" else image.convert("L"))
    except (Warning, Image.DecompressionBombError) as error:
        raise SessionDamaged(where, f"image too large: {in_one_line(error)}") from None
    except (OSError, SyntaxError, ValueError, struct.error):
        raise SessionDamaged(where, "is not a complete PNG or JPEG image") from None
