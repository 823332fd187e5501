"""Values of a session: a press and its condition, the results of steps, and the events of the journal.

A journal is one event a line, which `parse_event` reads.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from brushloop.sessions.records import Check, Condition, Header
from brushloop.sessions.records import Event as Value

MAX_NUMBER = 10**9
MAX_NAME_CHARS = 120
_SERIAL = re.compile(r"\d{1,9}(?=-)")


class StepKind(StrEnum):
    """What a step does."""

    ZERO_TOUCH = "zero_touch"
    BOARD = "board"
    DIP = "dip"
    PRESS = "press"  # once, or all strokes of a figure
    CAPTURE = "capture"
    REVIEW = "review"  # read which captures a person has marked bad; nothing moves
    SELF_CHECK = "self_check"  # press an uneven triangle of marks, which shows a mirrored, turned or stretched rig


StepFile = Annotated[str, Field(pattern=r"^\w[\w .-]*\.mcap(\.part)?$", max_length=MAX_NAME_CHARS)]
SnapshotFile = Annotated[str, Field(pattern=r"^\w[\w .-]*\.(toml|json)$", max_length=MAX_NAME_CHARS)]
"""Names of files in the session's folder: a journal from elsewhere may hold any name, also one that leads elsewhere."""
Whole = Annotated[int, Field(ge=0, le=MAX_NUMBER, strict=True)]
Number = Annotated[float, Field(strict=True)]
TimeNs = Annotated[int, Field(gt=-(2**63), lt=2**63, strict=True)]
Counts = dict[str, Whole]
"""Messages by topic."""
Point = tuple[Number, Number]


class Press(Value):
    """One press, or one figure of several strokes, whose condition is that of its deepest point.

    Sheet, patch and what was measured are None until they are known.
    """

    stroke_id: str
    condition: Condition
    take: Whole = 1
    sheet: Whole | None = None
    patch: Whole | None = None
    reached_mm: Number | None = None
    """Depth that the arm reached, along the paper's normal."""
    dip_to_touch_s: Annotated[Number, Field(ge=0.0)] | None = None
    """Time from the brush leaving the ink to its tip touching the paper; the longest if a figure has several dips."""


class TouchedPoint(Value):
    """One point of the paper, the mean of touches whose highest and lowest are `span_mm` apart.

    `sigma_mm` is the standard deviation of each touch; None where the method gives none.
    """

    x_mm: Number
    y_mm: Number
    z_mm: Number
    span_mm: Number = 0.0
    touches_mm: tuple[Number, ...] = ()
    sigma_mm: tuple[Number | None, ...] = ()


class ZeroTouchResult(Value):
    """Where the paper lies, in the base frame: its height at the sheet's origin, and its slope."""

    kind: Literal[StepKind.ZERO_TOUCH] = StepKind.ZERO_TOUCH
    method: str
    touch_z_mm: Number
    slope_x: Number = 0.0
    slope_y: Number = 0.0
    slope_deg: Number = 0.0
    residuals_mm: tuple[Number, ...] = ()
    """Point minus plane, in the order of the points."""
    points: tuple[TouchedPoint, ...] = ()
    moved_mm: Number = 0.0
    """How far the paper lies above where it was before."""


class BoardResult(Value):
    """The board as the camera sees it; `sheet_px` are the corners of the sheet in the photograph."""

    kind: Literal[StepKind.BOARD] = StepKind.BOARD
    still: Whole
    corners: Whole
    mm_per_px: Number
    rms_px: Number
    size_px: tuple[Whole, Whole]
    sheet_px: tuple[Point, ...]
    camera_delay_ms: Number | None = None
    camera_jitter_ms: Number | None = None
    checks: tuple[Check, ...] = ()


class SelfCheckResult(Value):
    """Three marks as commanded and as found; `residuals_mm` remain once offset and turn are taken out."""

    kind: Literal[StepKind.SELF_CHECK] = StepKind.SELF_CHECK
    sheet: Whole
    patches: tuple[Whole, ...]
    commanded_mm: tuple[Point, ...]
    found_mm: tuple[Point, ...]
    offset_mm: Point
    turn_deg: Number
    scale: Point
    residuals_mm: tuple[Number, ...]


class DipResult(Value):
    """The well before the dip, as far as it is measured, and the stroke that the operator leaves out, if any."""

    kind: Literal[StepKind.DIP] = StepKind.DIP
    ink_level: Number | None = None
    dosed_ml: Number | None = None
    skipped: Press | None = None


class PressResult(Value):
    """A press that was made, or a figure that was drawn."""

    kind: Literal[StepKind.PRESS] = StepKind.PRESS
    press: Press
    peak_force_n: Number | None = None
    depths_mm: tuple[Number, ...] = ()
    """Depth that the arm reached in each stroke of a figure."""


class CaptureResult(Value):
    """A photograph of a stroke, and whether the stroke counts."""

    kind: Literal[StepKind.CAPTURE] = StepKind.CAPTURE
    press: Press
    still: Whole
    """`sequence` of the still, unique in the session."""
    kept: bool = True
    retake: bool = False
    """Whether the stroke is pressed again on another patch."""
    verdict: str = ""
    """Name of the quality check that failed first."""
    camera_delay_ms: Number | None = None
    camera_jitter_ms: Number | None = None


class Again(Value):
    """A stroke that was marked bad, and the index of the steps that repeat it."""

    stroke_id: str
    index: Whole


class ReviewResult(Value):
    """The strokes that are pressed again."""

    kind: Literal[StepKind.REVIEW] = StepKind.REVIEW
    again: tuple[Again, ...] = ()


StepResult = Annotated[
    ZeroTouchResult | BoardResult | SelfCheckResult | PressResult | DipResult | CaptureResult | ReviewResult,
    Field(discriminator="kind"),
]


class _Event(Value):
    t_ns: TimeNs  # by the host's clock


class Open(_Event):
    """The session was made; its configuration is kept as text."""

    event: Literal["open"] = "open"
    header: Header
    snapshots: dict[SnapshotFile, str] = Field(default_factory=dict[str, str])


class Process(_Event):
    """A process opened the session."""

    event: Literal["process"] = "process"


class _Step(_Event):
    """An attempt at a step."""

    key: str
    kind: StepKind
    attempt: Whole
    sheet: Whole
    patches: tuple[Whole, ...] = ()
    """Patches that it marks."""
    file: StepFile


class Begin(_Step):
    """An attempt at a step began. Its patches are used from now on, whatever becomes of it."""

    event: Literal["begin"] = "begin"
    press: Press | None = None


class Done(_Step):
    """A step is finished, and never done again."""

    event: Literal["done"] = "done"
    sha256: str
    counts: Counts
    result: StepResult

    @property
    def press(self) -> Press | None:
        """The press that the step made, photographed or left out."""
        result = self.result
        if isinstance(result, PressResult | CaptureResult):
            return result.press
        return result.skipped if isinstance(result, DipResult) else None

    def begin(self) -> Begin:
        """The begin of the step, at the time of its end."""
        return Begin(**self.model_dump(include=set(_Step.model_fields)), press=self.press)


class StepEvent(Value):
    """The begin or the end of a step, as it travels with the step's file: a lost journal is rebuilt from these.

    A file cannot hold its own digest, which is empty.
    """

    step: Annotated[Begin | Done, Field(discriminator="event")]


class Void(_Event):
    """An attempt was cut; its patches stay used."""

    event: Literal["void"] = "void"
    key: str
    attempt: Whole
    why: str = ""


class FreshSheet(_Event):
    """A fresh sheet was put in."""

    event: Literal["sheet"] = "sheet"
    sheet: Whole


class Ended(_Event):
    """A run ended before its time."""

    event: Literal["ended"] = "ended"
    why: str


class Closed(_Event):
    """The steps were merged into one file, and that was read back."""

    event: Literal["closed"] = "closed"
    file: StepFile
    sha256: str
    counts: Counts


class Repaired(_Event):
    """A repair wrote the file of a step again."""

    event: Literal["repaired"] = "repaired"
    file: StepFile
    sha256: str
    counts: Counts
    missing: Counts = Field(default_factory=dict[str, int])
    why: str = ""


class Lost(_Event):
    """A repair could not recover a step: it counts as never done."""

    event: Literal["lost"] = "lost"
    file: StepFile
    why: str = ""


class Doubt(_Event):
    """A sheet may hold a press of which nothing is known: nothing more is pressed on it."""

    event: Literal["doubt"] = "doubt"
    sheet: Whole
    file: StepFile


class Remark(_Event):
    """A remark on the capture with this still, made afterwards, in a journal of its own; the latest counts."""

    event: Literal["remark"] = "remark"
    still: Whole
    stroke_id: str
    bad: bool = False
    note: str = ""


_OfSession = Open | Process | FreshSheet | Ended | Closed | Remark
_OfStep = Begin | Done | Void | Repaired | Lost | Doubt
Event = Annotated[_OfSession | _OfStep, Field(discriminator="event")]
_EVENTS: TypeAdapter[Event] = TypeAdapter(Event, config=ConfigDict(defer_build=True))


def parse_event(line: dict[str, Any]) -> Event:
    """The event in a line of a journal. Raises `ValueError`, naming the first field that is wrong."""
    try:
        return _EVENTS.validate_python(line)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
        field = ".".join(str(part) for part in problem["loc"][1:]) or "event"
        wrong = "is missing" if problem["type"] == "missing" else f"is wrong: {problem['msg']}"
        raise ValueError(f"{field!r} of event {str(line.get('event'))[:40]!r} {wrong}") from None


def step_words(step: Begin | Done) -> str:
    """Name of a step for people: `capture H13-a05-r02`."""
    stroke_id = "" if step.press is None else step.press.stroke_id
    return f"{step.kind} {stroke_id}".strip().replace("_", " ")


def serial_of(file: str) -> int:
    """Serial number at the start of the name of a step's file; -1 for a name without one."""
    serial = _SERIAL.match(file)
    return int(serial[0]) if serial else -1
