"""The table of a camera, and the capture of OpenCV that it names, with its settings locked."""

from __future__ import annotations

import http.client
import os
import time
from typing import TYPE_CHECKING, Annotated, Literal, cast
from urllib.parse import urlsplit

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

    def wanted(self) -> dict[str, float]:
        """The settings to lock, by name."""
        return {name: float(value) for name, value in self.model_dump(exclude_none=True).items()}


class CameraTable(BaseModel, frozen=True, extra="forbid"):
    """The table `[camera]` of `rig.toml` but for the lens: a camera that looks at the sheet."""

    kind: Literal["opencv"]
    source: str = Field(min_length=1)
    """Stream URL, video file, or device number as text."""
    latency_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = 250.0
    """Approximate time from exposure to arrival, used by `doctor` and the live picture. A run measures it."""
    max_delay_ms: Annotated[float, Field(ge=50.0, le=10_000.0)] = 1500.0
    """A camera whose measured delay is longer is refused."""
    max_jitter_ms: Annotated[float, Field(ge=10.0, le=10_000.0)] = 500.0
    """A camera whose measured delay varies by more is refused."""
    exact_delay: bool = False
    """Whether a delay that is not known to a tenth of its value (95 %) is measured again, then refused."""
    timeout_s: Annotated[float, Field(gt=0.0, le=120.0)] = 10.0
    locked: Locked = Locked()


SETTING_TOLERANCE = 0.01
"""Relative difference up to which a setting that is read back counts as applied."""


def says_loopback(url: str) -> bool:
    """Whether an HTTP server identifies itself as the loopback camera; False where it does not answer."""
    if not url.startswith("http://"):
        return False
    parts = urlsplit(url)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port or 80, timeout=2.0)
    try:
        connection.request("HEAD", parts.path or "/")
        return connection.getresponse().getheader("Server") == LOOPBACK_SERVER
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


class CaptureSource:
    """A `cv2.VideoCapture` on a device, a stream or a file, its settings locked and read back.

    Owned by one thread from open to release. `live` is False for a file; `independent` is True where FFmpeg decodes a
    JPEG for each frame; `settings` are those read back, by name; `simulated` is True for the loopback camera, which
    identifies itself, and for recordings.
    """

    def __init__(self, table: CameraTable) -> None:
        # Set before the first capture: otherwise the libraries would write their own lines across the screen.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        import cv2

        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        source = table.source
        is_device = source.isdecimal()
        self.live = is_device or "://" in source
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
            fourcc = int(self._capture.get(cv2.CAP_PROP_FOURCC))
            self.independent = not is_device and fourcc == cv2.VideoWriter.fourcc(*"MJPG")
            self.settings = self._lock(table, is_device)
            self.simulated = not self.live or says_loopback(source)
        except BaseException:
            self.release()
            raise

    def read(self) -> NDArray[np.uint8] | None:
        """The next frame; blocks up to the stream's own timeout."""
        ok, raw = self._capture.read()
        return cast("NDArray[np.uint8]", raw) if ok else None

    def release(self) -> None:
        """Close the capture."""
        self._capture.release()

    def _lock(self, table: CameraTable, is_device: bool) -> dict[str, float]:
        import cv2

        wanted = table.locked.wanted()
        if wanted and not is_device:
            names = ", ".join(wanted)
            raise DeviceError(
                DEVICE,
                "lock",
                f"{names} cannot be set through {table.source}",
                remedy="Lock them in the camera's own set-up and leave them out of the configuration.",
            )
        properties = _properties()
        automatic = {
            # V4L2's menu: 1 is manual, 3 aperture priority.
            "exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, 1.0),
            "white_balance_k": (cv2.CAP_PROP_AUTO_WB, 0.0),
            "focus": (cv2.CAP_PROP_AUTOFOCUS, 0.0),
        }
        settings: dict[str, float] = {}
        for name, value in wanted.items():
            if name in automatic:
                self._capture.set(*automatic[name])
            self._capture.set(properties[name], value)
        for name, value in wanted.items():
            got = float(self._capture.get(properties[name]))
            if abs(got - value) > SETTING_TOLERANCE * max(abs(value), 1.0):
                raise DeviceError(
                    DEVICE,
                    "lock",
                    f"{name} = {value:g} was asked for, but {got:g} is read back",
                    remedy="Choose a value that the camera has; `v4l2-ctl --list-ctrls` lists them.",
                )
            settings[name] = got
        return settings


def _properties() -> dict[str, int]:
    """OpenCV's number of each setting in `Locked`."""
    import cv2

    return {
        "width": cv2.CAP_PROP_FRAME_WIDTH,
        "height": cv2.CAP_PROP_FRAME_HEIGHT,
        "exposure": cv2.CAP_PROP_EXPOSURE,
        "gain": cv2.CAP_PROP_GAIN,
        "white_balance_k": cv2.CAP_PROP_WB_TEMPERATURE,
        "focus": cv2.CAP_PROP_FOCUS,
    }


def found_settings(device: int, settle_s: float) -> dict[str, float]:
    """What a device chose by itself within `settle_s`, by the names of `Locked`. Blocks for that long.

    A setting that the device does not have is left out.
    """
    import cv2

    capture = cv2.VideoCapture(device)
    try:
        until_s = time.monotonic() + settle_s
        while time.monotonic() < until_s and capture.read()[0]:
            pass
        settings = {name: float(capture.get(number)) for name, number in _properties().items()}
    finally:
        capture.release()
    return {name: value for name, value in settings.items() if value > 0.0 or (name == "exposure" and value < -0.5)}
