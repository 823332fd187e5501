"""The table of a camera, where its frames come from, and its settings, which are locked."""

from __future__ import annotations

import http.client
import os
import urllib.error
import urllib.request
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, cast

from pydantic import BaseModel, Field

from brushloop.drivers.errors import ConnectionLost, DeviceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEVICE = "camera"
LOOPBACK_SERVER = "brushloop-loopback"
"""The loopback camera's HTTP server name; no camera maker uses it."""

Setting = Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)]
Side = Annotated[int, Field(ge=16, le=65535)]


class Locked(BaseModel, frozen=True, extra="forbid"):
    """Camera settings that must not drift, in the device's own units; a setting that is left out is not changed.

    It is `[camera.locked]` of a `rig.toml`.
    """

    width: Side | None = None
    height: Side | None = None
    exposure: Setting | None = None
    """Turns automatic exposure off."""
    gain: Setting | None = None
    white_balance_k: Setting | None = None
    """Turns automatic white balance off."""
    focus: Setting | None = None
    """Turns autofocus off."""


class CameraTable(BaseModel, frozen=True, extra="forbid"):
    """The table `[camera]` of `rig.toml` but for the lens: a camera that looks at the sheet."""

    kind: Literal["opencv"]
    source: str = Field(min_length=1)
    """Stream URL, or device number as text."""
    latency_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = 250.0
    """Approximate time from exposure to arrival, used by `doctor` and the live picture. A run measures it."""
    max_delay_ms: Annotated[float, Field(ge=50.0, le=10_000.0)] = 1500.0
    """A camera whose measured delay is longer is refused."""
    max_jitter_ms: Annotated[float, Field(ge=10.0, le=10_000.0)] = 500.0
    """A camera whose measured delay varies by more is refused."""
    timeout_s: Annotated[float, Field(gt=0.0, le=120.0)] = 10.0
    locked: Locked = Locked()


PROPERTIES = {
    "width": ("CAP_PROP_FRAME_WIDTH", "", 0.0),
    "height": ("CAP_PROP_FRAME_HEIGHT", "", 0.0),
    "exposure": ("CAP_PROP_EXPOSURE", "CAP_PROP_AUTO_EXPOSURE", 1.0),  # V4L2's menu: 1 is manual, 3 aperture priority
    "gain": ("CAP_PROP_GAIN", "", 0.0),
    "white_balance_k": ("CAP_PROP_WB_TEMPERATURE", "CAP_PROP_AUTO_WB", 0.0),
    "focus": ("CAP_PROP_FOCUS", "CAP_PROP_AUTOFOCUS", 0.0),
}
"""OpenCV's name of each setting in `Locked`, what sets it by itself, and the value that switches that off."""
SETTING_TOLERANCE = 0.01
"""Relative difference up to which a setting that is read back counts as applied."""


class Capture:
    """A `cv2.VideoCapture` on a device or a stream, its settings locked and read back.

    `settings` are those read back, by name; `simulated` is True for the loopback camera, which identifies itself.
    """

    def __init__(self, table: CameraTable) -> None:
        """Raises `ConnectionLost` where it does not open, and `DeviceError` for a setting that it does not keep."""
        # OpenCV reads these at its first capture; without them FFmpeg writes its own lines across the screen, and looks
        # for a camera in the same room behind a proxy: "none" is no address. RTSP over TCP is OpenCV's own default.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", "http_proxy;none|rtsp_flags;prefer_tcp")
        import cv2

        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        source, is_device = table.source, table.source.isdecimal()
        locked = table.locked.model_dump(exclude_none=True)
        if locked and not is_device:
            what = f"{', '.join(locked)} cannot be set through {source}"
            remedy = "Fix them in the camera's own set-up, and remove them from [camera.locked] in rig.toml."
            raise DeviceError(DEVICE, "lock", what, remedy=remedy)
        if not is_device and ("://" not in source or source.startswith("file:")):
            what = f"{source} is neither the number of a device nor the address of a stream"
            raise ConnectionLost(DEVICE, "open", what)  # a recording would pass for the sheet
        self.simulated = _is_loopback(table)
        timeout_ms = round(table.timeout_s * 1e3)
        # One decoder thread: frame-parallel decoding would hold every frame back by one or more periods.
        stream = [
            *(cv2.CAP_PROP_N_THREADS, 1),
            *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, timeout_ms),
            *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, timeout_ms),
        ]
        self._capture = cv2.VideoCapture(int(source)) if is_device else cv2.VideoCapture(source, cv2.CAP_FFMPEG, stream)
        try:
            if not self._capture.isOpened():
                raise ConnectionLost(DEVICE, "open", f"cannot open {source}")
            is_jpeg = int(self._capture.get(cv2.CAP_PROP_FOURCC)) == cv2.VideoWriter.fourcc(*"MJPG")
            # JPEGs are not decoded here: FFmpeg would fill a cut one from the picture before.
            self._as_came = not is_device and is_jpeg and self._capture.set(cv2.CAP_PROP_FORMAT, -1)
            self.settings = self._lock(locked)
        except BaseException:
            self.close()
            raise

    def read(self) -> Picture | None:
        """The next picture, a JPEG of a stream as it came; None where the stream has ended or is silent for longer than
        its timeout, for which it blocks."""
        ok, raw = self._capture.read()
        if not ok:
            return None
        return raw.tobytes() if self._as_came else cast("NDArray[np.uint8]", raw)

    def close(self) -> None:
        """Close the capture."""
        self._capture.release()

    def _lock(self, wanted: dict[str, float]) -> dict[str, float]:
        import cv2

        for name, value in wanted.items():
            number, automatic, off = PROPERTIES[name]
            if automatic:
                self._capture.set(getattr(cv2, automatic), off)
            self._capture.set(getattr(cv2, number), value)
        settings = {name: float(self._capture.get(getattr(cv2, PROPERTIES[name][0]))) for name in wanted}
        for name, value in wanted.items():
            if abs(settings[name] - value) > SETTING_TOLERANCE * max(abs(value), 1.0):
                what = f"{name} = {value:g} was asked for, but {settings[name]:g} is read back"
                remedy = "Choose a value that the camera has; `v4l2-ctl --list-ctrls` lists them."
                raise DeviceError(DEVICE, "lock", what, remedy=remedy)
        return settings


def _is_loopback(table: CameraTable) -> bool:
    """Whether a stream says that it is the loopback camera's. Raises `ConnectionLost` where none answers."""
    host = table.source.partition("://")[2].partition("/")[0]
    if not table.source.startswith(("http://", "https://")) or "@" in host:  # FFmpeg logs in
        return False
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        with opener.open(table.source, timeout=table.timeout_s) as response:
            return response.headers["Server"] == LOOPBACK_SERVER
    except OSError as error:
        if isinstance(error, urllib.error.HTTPError):
            error.close()
        raise ConnectionLost(DEVICE, "open", f"cannot open {table.source}: {error}") from None
    except (ValueError, http.client.HTTPException):
        return False  # FFmpeg knows more kinds of streams


Picture: TypeAlias = "bytes | NDArray[np.uint8]"
"""A JPEG, or an (h, w) or (h, w, 3) BGR image."""
SCAN = b"\xff\xda"
"""Begins the picture in a JPEG, after the headers."""


def is_repeated(picture: Picture, before: Picture | None) -> bool:
    """Whether a picture is that of the frame before to the bit. Pictures of a camera that works have noise.

    The headers of a JPEG, which may contain the time, are not compared.
    """
    if isinstance(picture, bytes):
        return isinstance(before, bytes) and picture.partition(SCAN)[2] == before.partition(SCAN)[2]
    return not isinstance(before, bytes | None) and picture.shape == before.shape and bool((picture == before).all())
