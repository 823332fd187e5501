"""The tables of `rig.toml` for the devices: the address of each, and what it may do."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from brushloop.calibrate.board.lens import Lens
from brushloop.collect.rig.config_file import Config, Finite, Positive, Range
from brushloop.drivers.camera import Locked
from brushloop.drivers.force.sri_m8123 import LOOPBACK_CHANNEL

Turn = Annotated[float, Field(ge=-180.0, le=180.0)]
MOST_STALE_MS = 100.0
"""Longest silence allowed: at 20 mm/s the brush goes down 2 mm in this time without being felt."""
MOST_STALE_LOOPBACK_MS = 2000.0
"""The same on the loopback rig's bus, where simulated time may run faster than the sensor's rounds arrive."""


class LimitsConfig(Config):
    """The region that the brush tip must never leave, in the robot's base frame."""

    x_mm: Range
    y_mm: Range
    z_mm: Range
    """The lower end is the floor: paper height minus the deepest press."""
    tilt_deg: Annotated[float, Field(gt=0.0, le=30.0)] = 15.0
    speed_mm_s: Annotated[float, Field(gt=0.0, le=500.0)] = 250.0
    acc_mm_s2: Annotated[float, Field(gt=0.0, le=5000.0)] = 1000.0

    @model_validator(mode="after")
    def _ordered(self) -> LimitsConfig:
        for name in ("x_mm", "y_mm", "z_mm"):
            low, high = getattr(self, name)
            if low >= high:
                raise ValueError(f"{name} = [{low}, {high}]: the first must be less than the second")
        return self


POSE_LAG_MS = 100.0


class RobotConfig(Config):
    """The arm."""

    kind: Literal["aubo-arcs"]
    host: str = Field(min_length=1)
    port: int = Field(30004, ge=1, le=65535)
    tcp_offset_mm: tuple[Finite, Finite, Finite]
    """Flange to brush tip, along the flange's axes."""
    tcp_rotation_deg: Annotated[tuple[Turn, Turn, Turn], Field(exclude_if=lambda turn: not any(turn))] = (0.0, 0.0, 0.0)
    """Turn from the flange's axes to the brush's: about x, then y, then z of the flange. The brush is along its z.
    It is not written if it is zero, so that sessions older than this field can be resumed."""
    framing: Literal["sof", "bare"] = "sof"
    """`sof` as in the maker's client, `bare` as in the maker's documentation."""
    rtde_port: int | None = Field(None, ge=1, le=65535)
    """Port that pushes poses (30010); if left out, poses are polled."""
    max_pose_lag_ms: Annotated[float, Field(ge=60.0, le=5000.0, exclude_if=lambda ms: ms == POSE_LAG_MS)] = POSE_LAG_MS
    """Presses and touches during which poses arrive later than this are void: at 20 mm/s the recorded tip is 2 mm away
    from where force and camera saw it after 100 ms. Below 60 ms a busy computer's own lag would count."""
    watchdog_s: Annotated[float, Field(ge=0.5, le=60.0)] | None = None
    """Dead-man switch on the controller: after this long without a sign of life it makes a protective stop, which only
    a person can release and which leaves the brush where it is. If left out, it is not armed, and a press lifts by
    itself."""
    speed_fraction: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    collision_level: Annotated[int, Field(ge=1, le=9)] | None = None
    """1 to 9 (most sensitive); if left out, the pendant's setting stays."""
    payload_kg: Annotated[float, Field(ge=0.0, le=5.0)] | None = None
    """Mass of sensor, holder and brush; an i5 carries 5 kg. If left out, the pendant's setting stays."""
    payload_cog_mm: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    """Centre of that mass, from the flange."""
    limits: LimitsConfig

    @property
    def on_this_machine(self) -> bool:
        """Whether its controller has a loopback address, as the loopback rig's has."""
        return self.host in ("localhost", "::1") or self.host.startswith("127.")


class CameraConfig(Config):
    """The camera that looks at the sheet."""

    kind: Literal["opencv"]
    source: str = Field(min_length=1)
    """Stream URL, file, folder of images, or device number as text."""
    latency_ms: Annotated[float, Field(ge=0.0, le=10_000.0)] = 250.0
    """Approximate time from exposure to arrival, used by `doctor` and the live picture. A run measures it."""
    max_delay_ms: Annotated[float, Field(ge=50.0, le=10_000.0)] = 1500.0
    """A camera whose measured delay is longer is refused."""
    max_jitter_ms: Annotated[float, Field(ge=10.0, le=10_000.0)] = 500.0
    """A camera whose measured delay varies by more is refused."""
    exact_delay: bool = False
    """Whether a delay that is not known to a tenth of its value (95 %) is measured again, then refused."""
    timeout_s: Annotated[float, Field(gt=0.0, le=120.0)] = 10.0
    lens: str = ""
    """Name of the lens, for the record."""
    lens_file: Path | None = None
    """Written by `brushloop camera intrinsics`, beside rig.toml: distortion is removed before anything is measured."""
    optics: Lens | None = None
    """Contents of that file; filled in when rig.toml is read, so that the session holds them."""
    locked: Locked = Locked()


class ForceConfig(Config):
    """A force sensor between flange and brush, on a CAN bus of its own (docs/zero-touch.md)."""

    kind: Literal["sri-m8123"]
    interface: str = Field("socketcan", min_length=1)
    """As python-can names it: socketcan, slcan, pcan, socketcand and so on."""
    channel: str = Field("can0", min_length=1)
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    host: str | None = None
    """Address of a CAN gateway, for the interface socketcand."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    rate_hz: Annotated[float, Field(gt=0.0, le=2000.0)] = 200.0
    """Rate set on the sensor's board, from which gaps are counted."""
    max_n: Positive = 5.0
    """Ceiling while the brush is down: above it the arm is stopped and the press is void."""
    stale_ms: Annotated[float, Field(ge=20.0)] = 100.0
    """While the brush goes down, silence of this length stops the arm; at most 100, except on the loopback bus."""
    bias_s: Annotated[float, Field(ge=0.05, le=60.0)] = 0.5
    """How long to average with nothing touching, before each zero touch."""

    @model_validator(mode="after")
    def _gateway(self) -> ForceConfig:
        if (self.interface == "socketcand") != (self.host is not None and self.port is not None):
            raise ValueError("host and port belong to the interface socketcand, and to no other")
        return self

    @model_validator(mode="after")
    def _fresh(self) -> ForceConfig:
        most_ms = MOST_STALE_LOOPBACK_MS if self.channel == LOOPBACK_CHANNEL else MOST_STALE_MS
        if self.stale_ms > most_ms:
            raise ValueError(
                f"stale_ms = {self.stale_ms:g}: must be from 20 to {most_ms:g}; the brush is blind that long"
            )
        return self
