"""What is recorded: topics, their schemas, and our own events as frozen pydantic models.

Foxglove's types are protobuf, so that any viewer shows them; our events are JSON, so that any reader reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from sessions.names import bare_name

SCHEMA_VERSION = 1


def _bare_or_empty(value: str) -> str:
    return bare_name(value) if value else value


BareName = Annotated[str, AfterValidator(_bare_or_empty)]
"""A name that becomes that of a file or folder, and so must not lead to another one; empty before it is known."""


class Topic(StrEnum):
    """Every topic that a session may hold."""

    TCP = "/robot/tcp"
    JOINTS = "/robot/joints"
    TRANSFORMS = "/tf"
    STILL = "/camera/still"
    CALIBRATION = "/camera/calibration"
    PREVIEW = "/camera/preview"
    WRENCH = "/force/wrench"
    INK = "/ink/state"
    QUALITY = "/quality"
    CADENCE = "/cadence"
    STEP = "/step"
    STROKE = "/stroke"
    LOG = "/log"


class Source(StrEnum):
    """Where the ink comes from. Set by whoever records, from what the devices say; never from configuration."""

    LOOPBACK = "loopback rig"
    REAL = "real capture"
    IMPORT = "imported photographs"


MIN_PX_PER_MM, MAX_PX_PER_MM = 0.01, 10_000.0
PxPerMm = Annotated[float, Field(ge=MIN_PX_PER_MM, le=MAX_PX_PER_MM)]


class Event(BaseModel):
    """Base of our JSON messages: frozen, nothing unknown is let in, and no NaN (JSON would write it as null)."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class StepEvent(Event):
    """A step began or ended. The journal holds the same; this copy travels with the file."""

    key: str
    kind: str
    index: int
    attempt: int
    phase: Literal["begin", "end"]
    params: dict[str, float | int | str | bool | None]


class Stroke(Event):
    """One captured mark: what was asked for, where it is, and which still shows it."""

    stroke_id: str
    """Stable name: `H13-a05-r02` for a grid press, the file's stem for an import."""
    kind: Literal["press", "drag"]
    still: int = Field(ge=0)
    """`sequence` of the message on /camera/still that shows this stroke."""
    height_mm: float | None = None
    """Commanded press depth H; None where the source does not tell one."""
    tilt_deg: float | None = None
    heading_deg: float = 0.0
    cell_mm: tuple[float, float, float, float] | None = None
    """x, y, width, height of the paper cell in the paper frame."""
    anchor_mm: tuple[float, float] | None = None
    """Commanded zero-touch point in the paper frame."""
    anchor_px: tuple[float, float] | None = None
    """The same in the still, for imports that tell it."""
    px_per_mm: tuple[PxPerMm, PxPerMm] | None = None
    """Scale in x and y, for imports that tell it."""
    again_of: str | None = None
    """The stroke of an earlier session that this one repeats."""
    dip_to_touch_s: float | None = Field(default=None, ge=0.0)
    """From the brush leaving the ink to its tip on the paper; of a figure that dips several times, the longest."""
    commanded: dict[str, float] = Field(default_factory=dict[str, float])
    """Whatever else the source commanded, by name with unit (`length_mm`, `bend_mm`, ...)."""


class Wrench(Event):
    """One sample of the force sensor, in its own frame, its bias subtracted."""

    fx_n: float
    fy_n: float
    fz_n: float
    mx_nm: float
    my_nm: float
    mz_nm: float


class InkState(Event):
    """What is known of the ink station; None where it cannot tell."""

    level: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    """Fill of the well."""
    dosed_ml: Annotated[float, Field(ge=0.0)] | None = None
    """Pumped since the session's process began."""
    light: Annotated[float, Field(ge=0.0, le=1.0)] | None = None


class Check(Event):
    """One question asked of a capture."""

    name: str
    score: float | None = None
    """What was measured; None where it could not be."""
    threshold: float | None = None
    passed: bool
    reason: str = ""
    """In words for the operator; empty where the check passed."""


class Quality(Event):
    """The checks of one stroke."""

    stroke_id: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)


class SlowSection(Event):
    """A part of a loop that took longer than it may."""

    name: str
    times: int = Field(ge=1)
    longest_ms: float = Field(ge=0.0)


class Cadence(Event):
    """How steadily a topic came, over one step."""

    topic: str
    expected_hz: float = Field(gt=0.0)
    received: int = Field(ge=0)
    missed: int = Field(ge=0)
    """Slots of 1 / `expected_hz` in which nothing came."""
    longest_gap_ms: float | None = Field(default=None, ge=0.0)
    """None for fewer than two messages."""
    slow_sections: tuple[SlowSection, ...] = ()


class Header(Event):
    """Who made this recording, on what, with what. Written first, into every file of a session."""

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
    """Empty where a person keeps the well filled."""
    force_sensor: str = ""
    """Empty where there is none."""
    paper: str = ""
    protocol: str = ""
    licence: str = ""
    origin: str = ""
    """For imports: the folder's name and its table."""


class TornTail(Event):
    """Bytes of a journal line that a crash cut off, kept so that nothing written is ever lost."""

    event: Literal["torn"] = "torn"
    hex: str


@dataclass(frozen=True, slots=True)
class Recorded:
    """Counts of messages by topic, and the digest of the file that holds them."""

    counts: dict[str, int]
    sha256: str
    size_bytes: int
