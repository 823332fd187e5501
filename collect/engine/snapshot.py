"""What a screen shows of a run: one immutable `Snapshot`, plain values only, so that a screen imports it quickly."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brushloop.collect.engine.control import State
    from brushloop.collect.engine.last_capture import LastCapture
    from brushloop.collect.operator import OperatorRequest, Prompt


@dataclass(frozen=True, slots=True)
class CellCount:
    """Strokes of one condition."""

    condition: Condition
    done: int
    planned: int
    bad: int = 0
    """Captures that did not count."""
    left_out: int = 0
    """Strokes that were given up."""
    now: bool = False
    """The stroke in progress has this condition."""
    next: bool = False
    """The next planned stroke has this condition."""

    @property
    def over(self) -> bool:
        """Whether every planned stroke was pressed or given up."""
        return self.done + self.left_out >= self.planned


class Mark(StrEnum):
    """State of a paper patch that is not blank."""

    NOW = "now"
    WAITING = "pressed"
    """Not photographed yet."""
    KEPT = "kept"
    BAD = "bad"
    """Photographed, but does not count."""
    VOID = "void"
    """The press was cut short."""
    CHECK = "self-check"


@dataclass(frozen=True, slots=True)
class SheetMap:
    """The current sheet, patch by patch, row by row from the far edge."""

    number: int
    """From 1."""
    columns: int
    rows: int
    marks: tuple[Mark | None, ...]
    """None for a blank patch."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A reduced picture of the camera's newest frame."""

    number: int
    image: NDArray[np.uint8]
    """(h, w) gray."""
    blur_px: float | None = None
    """Standard deviation of the blur at the steepest edges, in pixels of the full frame; None without an edge."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a run at one moment."""

    session_id: str
    source: str
    state: State
    step: str
    """What is being done, in words."""
    strokes_done: int
    strokes_planned: int
    grid: tuple[CellCount, ...]
    voids: int
    """Attempts that were cut short."""
    elapsed_s: float
    eta_s: float | None
    """Remaining time in seconds; None until a stroke has been timed."""
    messages: tuple[str, ...]
    """The newest lines of the log, oldest first."""
    error: str
    """Why the run failed or stopped; empty otherwise."""
    tip_mm: tuple[float, float, float] | None = None
    """Position of the brush tip; None while the arm sends no fresh pose."""
    given_up: int = 0
    """Strokes that were left out, because every take was bad or the operator asked for it."""
    force_n: float | None = None
    """Force less the sensor's bias; None without a sensor or a fresh sample."""
    force_ceiling_n: float | None = None
    """Force above which the arm is stopped while the brush is down; None without a sensor."""
    ink_level: float | None = None
    """Level of the well before the last dip, 0 to 1; None if nothing measures it."""
    prompt: Prompt | None = None
    """Question that waits for an answer."""
    messages_before: int = 0
    """Number of older log lines that `messages` no longer holds."""
    target_mm: tuple[float, float, float] | None = None
    """Where the arm was last sent."""
    parked: bool = False
    """Whether the tip was last seen at the park position."""
    rest_unknown: bool = False
    """The run is over, and it is not known that the arm is at rest."""
    trace_n: tuple[float, ...] = ()
    """Peak force of each tenth of a second, oldest first."""
    picture: Picture | None = None
    """Picture of the camera; None without a preview."""
    sheet: SheetMap | None = None
    last: LastCapture | None = None
    """Newest capture of this process."""
    requests: tuple[OperatorRequest, ...] = ()
    """Key requests that are still pending."""
    folder: str = ""
    """Folder of the session; empty until there is one."""
    no_pose_s: float | None = None
    """Time since the arm last sent a pose; None below a second. While it is set, no value on the screen is live."""
