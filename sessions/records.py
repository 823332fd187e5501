"""Recorded data: topics, their schemas, and our own events as frozen pydantic models.

Foxglove's types are protobuf, which any viewer shows; our events are JSON, which any program reads.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from brushloop.sessions.disk import SESSION_ID

SCHEMA_VERSION = 1
HEADER_FILE = "header.json"
"""Attachment of every recording: its `Header`."""
REPAIRS_FILE = "repairs.json"
"""Attachment of the merged file of a repaired session: what was rewritten, what is missing, and what was lost."""
BareName = Annotated[str, Field(pattern=f"^({SESSION_ID.pattern})?$")]
"""Name of a session or of a file in one; empty until it is known."""


class Topic(StrEnum):
    """Topics of a session: the first carry Foxglove's messages (`messages.py`), the others the events below."""

    TCP = "/robot/tcp"  # PoseInFrame
    JOINTS = "/robot/joints"  # JointStates
    TRANSFORMS = "/tf"  # FrameTransforms
    CALIBRATION = "/camera/calibration"  # CameraCalibration
    STILL = "/camera/still"  # CompressedImage, PNG
    PREVIEW = "/camera/preview"  # CompressedImage, JPEG
    LOG = "/log"  # Log
    WRENCH = "/force/wrench"
    INK = "/ink/state"  # InkState
    QUALITY = "/quality"
    STEP = "/step"  # StepEvent, in events.py
    STROKE = "/stroke"


class Source(StrEnum):
    """Origin of the ink. Set when recording, from what the devices report, and never from configuration; the person who
    imports pictures of simulated ink declares them as such."""

    LOOPBACK = "loopback rig"
    REAL = "real capture"
    IMPORT = "imported photographs"
    IMPORT_SIMULATED = "imported simulation"

    @property
    def imported(self) -> bool:
        """Whether brushloop did not collect it."""
        return self in (Source.IMPORT, Source.IMPORT_SIMULATED)


MIN_PX_PER_MM, MAX_PX_PER_MM = 0.01, 10_000.0
PxPerMm = Annotated[float, Field(ge=MIN_PX_PER_MM, le=MAX_PX_PER_MM)]


class Event(BaseModel):
    """Base of our JSON messages: frozen, without unknown fields or NaN (JSON would write it as null)."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True, allow_inf_nan=False)


class Stroke(Event):
    """One captured mark: what was commanded, its place, and the still that shows it."""

    stroke_id: str
    """Stable name: `H13-a05-r02` for a grid press, the file's stem for an import."""
    kind: Literal["press", "drag"]
    still: int = Field(ge=0)
    """`sequence` of the message on /camera/still that shows this stroke."""
    depth_mm: Annotated[float, Field(ge=0.0, le=500.0)] | None = None
    """Commanded press depth H; None where the source has none."""
    reached_mm: float | None = None
    """Depth that the arm reached, measured along the paper's normal; None where it was not measured."""
    tilt_deg: Annotated[float, Field(ge=-90.0, le=90.0)] | None = None
    heading_deg: float = 0.0
    cell_mm: tuple[float, float, float, float] | None = None
    """x, y, width, height of the paper patch in the paper frame."""
    anchor_mm: tuple[float, float] | None = None
    """Commanded zero-touch point in the paper frame."""
    anchor_px: tuple[float, float] | None = None
    """Commanded zero-touch point in the still, for imports that have it."""
    px_per_mm: tuple[PxPerMm, PxPerMm] | None = None
    """Scale in x and y, for imports that have it."""
    again_of: str | None = None
    """The stroke of an earlier session that this one repeats."""
    dip_to_touch_s: float | None = Field(default=None, ge=0.0)
    """Time from the brush leaving the ink to its tip touching the paper; the longest if a figure has several dips."""
    commanded: dict[str, float] = Field(default_factory=dict[str, float])
    """Other commanded values, by name with unit (`length_mm`, `bend_mm`, ...)."""


class Wrench(Event):
    """One sample of the force sensor, in its own frame, its bias subtracted."""

    fx_n: float
    fy_n: float
    fz_n: float
    mx_nm: float
    my_nm: float
    mz_nm: float


class InkState(Event):
    """State of the ink station; None where it does not report a value."""

    level: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Fill of the well."""
    dosed_ml: Annotated[float, Field(ge=0.0)] | None = None
    """Volume pumped since the session's process began."""
    light: Annotated[float, Field(ge=0.0, le=1.0)] | None = None


class Check(Event):
    """One quality check of a capture."""

    name: str
    score: float
    """Measured value."""
    threshold: float
    unit: str = ""
    passed: bool
    reason: str = ""
    """Why the check failed and what to do about it; empty if it passed."""


class Quality(Event):
    """Quality checks of one stroke."""

    stroke_id: str
    checks: tuple[Check, ...]

    @property
    def verdict(self) -> str:
        """`passed`, or `failed: ` and the names of the checks that failed."""
        failed = ", ".join(check.name for check in self.checks if not check.passed)
        return f"failed: {failed}" if failed else "passed"


class Header(Event):
    """Devices, material and software of a recording. Written first, into every file of a session."""

    schema_version: int = SCHEMA_VERSION
    session_id: BareName
    source: Source
    software: str
    robot: str = ""
    robot_firmware: str = ""
    camera: str = ""
    lens: str = ""
    brush: str = ""
    brush_radius_mm: float | None = None
    brush_length_mm: float | None = None
    ink: str = ""
    ink_device: str = ""
    """Empty where a person refills the well."""
    force_sensor: str = ""
    """Empty where there is none."""
    paper: str = ""
    protocol: str = ""
    licence: str = ""
    origin: str = ""
    """For imports: the folder's name and its table."""


@dataclass(frozen=True, slots=True, order=True)
class Condition:
    """Depth H below the paper, tilt alpha of the brush axis from the vertical, and heading of the mark."""

    depth_mm: float
    tilt_deg: float
    heading_deg: float = 0.0
