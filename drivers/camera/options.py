"""What a camera is told, and what it is held to."""

from __future__ import annotations

from dataclasses import dataclass, fields

DEVICE = "camera"
LOOPBACK_SERVER = "brushloop-loopback"
"""What the loopback camera calls itself in HTTP; no camera maker does."""


@dataclass(frozen=True, slots=True)
class Locked:
    """Settings that must not drift during a session; None leaves one as it is. Values are the driver's own units."""

    width: int | None = None
    height: int | None = None
    exposure: float | None = None
    """Turns automatic exposure off."""
    gain: float | None = None
    white_balance_k: float | None = None
    """Turns automatic white balance off."""
    focus: float | None = None
    """Turns autofocus off."""

    def wanted(self) -> dict[str, float]:
        """The settings that are asked for, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: float(value) for name, value in values.items() if value is not None}


@dataclass(frozen=True, slots=True)
class CameraOptions:
    """`source` is a stream URL, a file, a folder of images, or a device number as text."""

    source: str
    latency_ms: float = 250.0
    """The longest time from exposure to arrival; a frame counts as exposed after (arrival - latency)."""
    timeout_s: float = 10.0
    gray: bool = True
    """Ink on paper has no colour worth three times the disk."""
    locked: Locked = Locked()
    folder_fps: float = 10.0
    """Pace at which a folder of images is shown."""
    frozen_after: int = 5
    """So many equal frames in a row mean that the camera has stopped looking; real ones have noise."""
