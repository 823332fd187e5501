"""What a step works with: the rig during a run, and the attempt that is being recorded."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from brushloop.calibrate.board.pix2len import Plane, see_board
from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.engine.progress import Progress
from brushloop.collect.engine.recorder import ForceGuard, Recorder
from brushloop.collect.errors import BadPicture, ConfigError, StepError
from brushloop.collect.motion import Procedures
from brushloop.collect.operator import Asker, OperatorRequests
from brushloop.collect.protocols.config import ProtocolConfig
from brushloop.collect.rig.devices import Rig
from brushloop.collect.rig.paper import Patch, Sheet
from brushloop.collect.touch.heights import used_patches as touched_patches
from brushloop.drivers.host import finished
from brushloop.sessions.store import Attempt, SessionStore

if TYPE_CHECKING:
    from brushloop.calibrate.stroke import Gray

_R = TypeVar("_R")


@dataclass(slots=True)
class RunContext:
    """The rig, the session and the operator, for the length of a run, and in what state brush, well and view are.

    A new process knows nothing of that state.
    """

    rig: Rig
    store: SessionStore
    progress: Progress
    asker: Asker
    procedures: Procedures
    sheet: Sheet
    protocol: ProtocolConfig
    requests: OperatorRequests = field(default_factory=OperatorRequests)
    left_ink_ns: int | None = None
    """Host time at which the brush left the ink; None if it has marked since or may have lost its ink."""
    view: Plane | None = None
    """Where the paper lies in the newest frame in which the board was seen."""
    view_of: tuple[Gray, Plane] | None = None
    """The frame that was last searched for the board, and its plane: a capture is judged, then shown."""
    sound_frame: Gray | None = None
    """Newest valid gray photograph of the current sheet."""
    looked_at_sheet: int | None = None
    """Sheet whose free patches were seen to be blank."""
    dips: int = 0
    """Dips since the run began."""
    light: float | None = None
    """Light of the ink station as it was set; None without one."""

    def used_patches(self) -> set[int]:
        """Cells of the current sheet on which any mark was started, or which zero touch may ink."""
        state, config = self.store.state, self.rig.config
        marked = {patch for sheet, patch in state.used_patches if sheet == state.sheet}
        return marked | touched_patches(self.sheet, config.paper, config.touch)

    def image_plane(self, image: Gray) -> Plane:
        """Where the paper lies in this frame: from the board in it, else from the newest frame that showed one.

        Raises `BadPicture` if none did.
        """
        if self.view_of is not None and self.view_of[0] is image:
            return self.view_of[1]
        try:
            self.view = see_board(image, self.rig.config.board)
        except CalibrationError as error:
            if self.view is None:
                raise BadPicture(f"the board is not seen: {error.what}") from None
        self.view_of = image, self.view
        return self.view

    def forget_camera(self) -> None:
        """Measure the camera's delay again before the next photograph: a person may have changed what it sees."""
        self.procedures.photographer.forget()

    def fresh_sheet(self) -> None:
        """Record that a person has put a fresh sheet in."""
        self.store.fresh_sheet()
        self.sound_frame = None
        self.forget_camera()


@dataclass(frozen=True, slots=True)
class StepContext:
    """One attempt at one step."""

    run: RunContext
    patches: tuple[Patch, ...]
    """Patches that this step marks."""
    attempt: Attempt
    recorder: Recorder
    guard: ForceGuard


async def meanwhile(moving: Coroutine[Any, Any, None], work: Coroutine[Any, Any, _R]) -> _R:
    """Do `work` while the arm moves; return its result once both have ended, on failure and cancellation too.

    Raises the error of the motion before that of the work. Work that fails does not stop the arm, which is under way to
    where it may wait.
    """
    moved, done = await asyncio.gather(moving, work, return_exceptions=True)
    for ended in (moved, done):
        if isinstance(ended, BaseException):
            raise ended
    return cast("_R", done)


async def uninterrupted(function: Callable[..., _R], *args: object) -> _R:
    """Run `function` in a thread; on cancellation wait until it has returned.

    An unfinished file operation is worse than one that ends a few milliseconds after the stop key.
    """
    return await finished(asyncio.to_thread(function, *args))


async def within_limits(check: Callable[..., None], where: str, *arguments: object) -> None:
    """Run a check of `planning.limit_check` in a thread: it takes seconds for a long protocol, and a stop takes effect
    meanwhile. Raises `StepError`, which begins with `where`."""
    try:
        await asyncio.to_thread(check, Path("rig.toml"), *arguments)
    except ConfigError as error:
        raise StepError(f"{where}{error.what}") from None
