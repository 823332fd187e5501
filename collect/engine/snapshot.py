"""What a screen may know: one immutable picture of the engine, made anew when asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    # A screen is up before what it shows is imported.
    from collect.engine.last_capture import LastCapture
    from collect.engine.set_up_steps import SetUpStep
    from collect.engine.states import State
    from collect.engine.tally import SheetMap
    from collect.engine.telemetry import Picture
    from collect.operator import OperatorRequest, Prompt


@dataclass(frozen=True, slots=True)
class CellCount:
    """Progress of one (H, alpha) of the grid."""

    height_mm: float
    tilt_deg: float
    done: int
    planned: int
    bad: int = 0
    """Captures that came out badly."""
    left_out: int = 0
    """Strokes that were given up."""
    now: bool = False
    """One of its strokes is being made."""
    next: bool = False
    """The next stroke is one of its."""

    @property
    def over(self) -> bool:
        """Whether nothing more is to come."""
        return self.done + self.left_out >= self.planned


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The engine now."""

    session_id: str
    source: str
    state: State
    step: str
    """What is being done, in words."""
    strokes_done: int
    strokes_planned: int
    grid: tuple[CellCount, ...]
    voids: int
    elapsed_s: float
    eta_s: float | None
    """Seconds to go; None until a stroke has been timed."""
    tip_mm: tuple[float, float, float] | None
    """None where the arm has not told its pose lately."""
    messages: tuple[str, ...]
    """The newest lines of the log, oldest first."""
    error: str
    """Why it failed or stopped; empty while all is well."""
    given_up: int = 0
    """Strokes that came out badly every time and were left out."""
    force_n: float | None = None
    """Of the force sensor, less its bias; None without one, or where it has not told lately."""
    ink_level: float | None = None
    """Of the well, 0 to 1, before the last dip; None where nothing can tell."""
    prompt: Prompt | None = None
    """What waits for an answer."""
    messages_before: int = 0
    """How many older lines of the log are not in `messages` any more."""
    target_mm: tuple[float, float, float] | None = None
    """Where the arm was last sent."""
    parked: bool = False
    """Whether the tip was last seen at the park position."""
    rest_unknown: bool = False
    """The run is over, and nobody knows that the arm rests."""
    trace_n: tuple[float, ...] = ()
    """Peaks of the force by tenth of a second, oldest first."""
    picture: Picture | None = None
    """What the camera sees; None where no preview is wanted."""
    sheet: SheetMap | None = None
    last: LastCapture | None = None
    """The newest capture of this process."""
    stroke: str = ""
    """The stroke in hand."""
    requests: tuple[OperatorRequest, ...] = ()
    """What was asked for by key and still waits."""
    set_up: tuple[SetUpStep, ...] = ()
    """Of a guided set-up; empty once it is over, and where there is none."""
    folder: str = ""
    """Of the session, once there is one."""
    no_pose_s: float | None = None
    """For so long the arm has told no pose, though it should; None below a second. Nothing on the screen is live."""


class EngineView(Protocol):
    """What a screen may do: look, pause, go on, request, park, stop."""

    def snapshot(self) -> Snapshot:
        """The engine now; never blocks."""
        ...

    def pause(self) -> None:
        """Pause before the next step; from any thread."""
        ...

    def resume(self) -> None:
        """Go on after a pause; from any thread."""
        ...

    def answer(self, number: int, key: str) -> bool:
        """Answer the prompt of that number; False where it is over. From any thread."""
        ...

    def request(self, request: OperatorRequest) -> None:
        """Ask for something, or take it back; from any thread."""
        ...

    def park(self) -> None:
        """End the run after this step with the arm lifted and parked; from any thread. Nobody is asked any more."""
        ...

    def stop(self) -> None:
        """Stop the arm now and end the run; from any thread, in any state. Not an emergency stop."""
        ...
