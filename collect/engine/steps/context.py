"""What a step works with: the rig and what is known of it in this process, and the attempt that is being recorded."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from calibrate.board.plane import Plane
from collect.engine.force_guard import ForceGuard
from collect.engine.inking import Inking
from collect.engine.progress import Progress
from collect.engine.recorder import Recorder
from collect.motion.procedures import Procedures
from collect.operator import Asker, OperatorRequests
from collect.protocols.config import ProtocolConfig
from collect.protocols.steps import Step
from collect.rig.devices import Rig
from collect.rig.paper import Cell, Sheet
from collect.touch.places import used_cells as touched_cells
from sessions.store import Attempt, SessionStore

if TYPE_CHECKING:
    from calibrate.stroke.preprocess import Gray


@dataclass(slots=True)
class Known:
    """What one process has found out and does not keep: a new one looks again."""

    left_ink_ns: int | None = None
    """When the brush left the ink, by the host's clock; None where it has marked since, or may have lost it."""
    image_plane: Plane | None = None
    """Of the newest frame in which the board was seen."""
    sound_frame: Gray | None = None
    """The newest gray photograph of the sheet that is in."""
    looked_at_sheet: int | None = None
    """The sheet whose free cells were seen to be blank."""


@dataclass(frozen=True, slots=True)
class RunContext:
    """The rig for the length of a run."""

    rig: Rig
    store: SessionStore
    progress: Progress
    asker: Asker
    procedures: Procedures
    inking: Inking
    sheet: Sheet
    protocol: ProtocolConfig
    known: Known = field(default_factory=Known)
    requests: OperatorRequests = field(default_factory=OperatorRequests)

    def used_cells(self) -> set[int]:
        """Cells of the sheet that is in on which a mark was ever begun, or that zero touch may ink."""
        state, config = self.store.state, self.rig.config
        marked = {cell for sheet, cell in state.used_cells if sheet == state.sheet}
        return marked | touched_cells(self.sheet, config.paper, config.touch)


@dataclass(frozen=True, slots=True)
class StepContext:
    """One attempt at one step."""

    run: RunContext
    step: Step
    cell: Cell | None
    """That it marks."""
    more_cells: tuple[Cell, ...]
    """That it marks besides."""
    attempt: Attempt
    recorder: Recorder
    guard: ForceGuard

    def number(self, name: str) -> float:
        """A parameter that is a number."""
        value = self.step.params[name]
        assert isinstance(value, float | int)
        return float(value)
