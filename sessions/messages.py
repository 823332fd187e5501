"""Foxglove messages from plain values, and back."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
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


def transform_message(
    t_ns: int,
    parent: str,
    child: str,
    translation_mm: tuple[float, float, float],
    quaternion: tuple[float, float, float, float],
) -> FrameTransforms:
    """The transform (x, y, z, w) from a child frame's coordinates to its parent's; metres on disk."""
    message = FrameTransforms()
    transform = message.transforms.add(parent_frame_id=parent, child_frame_id=child)
    transform.timestamp.FromNanoseconds(t_ns)
    there, turned = transform.translation, transform.rotation
    there.x, there.y, there.z = (v / 1e3 for v in translation_mm)
    turned.x, turned.y, turned.z, turned.w = quaternion
    return message


def calibration_message(
    t_ns: int,
    size_px: tuple[int, int],
    camera_matrix: Sequence[Sequence[float]],
    distortion: Sequence[float],
) -> CameraCalibration:
    """Intrinsics of a single, unrectified camera: R is the identity, P is [K | 0].

    `camera_matrix` is K, 3 x 3 in pixels; `distortion` is k1, k2, p1, p2, k3.
    """
    message = CameraCalibration(
        frame_id="camera",
        width=size_px[0],
        height=size_px[1],
        distortion_model="plumb_bob",
        D=distortion,
        K=[v for row in camera_matrix for v in row],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[v for row in camera_matrix for v in [*row, 0.0]],
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
    """Decode a PNG or JPEG to (h, w) uint8 gray, turned as its orientation says, so that pixels count as viewers show.

    Raises `SessionDamaged` for other formats, and for cut or absurdly large images.
    """
    import numpy as np
    from PIL import Image, ImageOps

    if len(data) > MAX_IMAGE_BYTES:
        raise SessionDamaged(where, f"image of {len(data)} bytes exceeds {MAX_IMAGE_BYTES}")
    if data.count(b"\xff\xda") > MAX_JPEG_SCANS and not data.startswith(PNG_START):
        raise SessionDamaged(where, f"JPEG image in more than {MAX_JPEG_SCANS} scans")
    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            image.verify()  # the CRCs of a PNG, before anything is unpacked
        with Image.open(io.BytesIO(data)) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                what = f"image of {image.width} x {image.height} pixels exceeds {MAX_IMAGE_PIXELS}"
                raise SessionDamaged(where, what)
            image.draft("L", image.size)
            upright = ImageOps.exif_transpose(image)
            if upright.mode.startswith("I"):
                return (np.asarray(upright) >> 8).astype(np.uint8)  # 16 bits
            return np.asarray(upright.convert("L"))
    except (Warning, Image.DecompressionBombError) as error:
        raise SessionDamaged(where, f"image too large: {in_one_line(error)}") from None
    except (OSError, SyntaxError, ValueError, struct.error):
        raise SessionDamaged(where, "is not a complete PNG or JPEG image") from None


def upright(data: bytes, where: str) -> bytes:
    """The photograph itself, or, where its orientation says that it is turned, what is decoded of it, as PNG.

    Readers differ in whether they turn a picture: without the mark every reader sees the same pixels, and a point
    measured in a viewer lies where it was measured. Raises `SessionDamaged`.
    """
    from PIL import ExifTags, Image

    image = decode_gray(data, where)
    with Image.open(io.BytesIO(data)) as stored:
        turned = stored.getexif().get(ExifTags.Base.Orientation, 1) != 1
    return encode_png(image) if turned else data
