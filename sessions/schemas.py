"""What is recorded: topics, their schemas, and our own events as frozen pydantic models.

Foxglove's types are protobuf, so that any viewer shows them; our events are JSON, so that any reader reads them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA_VERSION = 1


class Topic(StrEnum):
    """Every topic that a session may hold."""

    TCP = "/robot/tcp"
    STILL = "/camera/still"
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
    commanded: dict[str, float] = Field(default_factory=dict[str, float])
    """Whatever else the source commanded, by name with unit (`length_mm`, `bend_mm`, ...)."""


class Header(Event):
    """Who made this recording, on what, with what. Written first, into every file of a session."""

    schema_version: int = SCHEMA_VERSION
    session_id: str
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
