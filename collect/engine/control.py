"""The state of a run, and what its keys have asked of it: asked from any thread, heeded by the engine's."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable

from collect.engine.states import FINAL, State, check_transition


class RunControl:
    """One lock over the state and the requests to stop, pause and park. Nothing here talks to a device."""

    def __init__(self, doing: Callable[[str], None]) -> None:
        """`doing` is told what the run does, in words."""
        self._doing = doing
        self._lock = threading.Lock()
        self._state = State.IDLE
        self._loop: asyncio.AbstractEventLoop | None = None
        self._go_on = asyncio.Event()
        self._stop_wanted = False
        self._pause_wanted = False
        self._park_wanted = False
        self._closing = False

    @property
    def state(self) -> State:
        """What the run is doing."""
        return self._state

    @property
    def park_wanted(self) -> bool:
        """Whether the run is to end before the next step."""
        return self._park_wanted

    @property
    def closing(self) -> bool:
        """All is collected and the arm parked; what is left ends by itself."""
        return self._closing

    def entered(self, task: asyncio.Task[None]) -> None:
        """The engine's loop runs, and `task` in it; a stop that came before cancels it."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if self._stop_wanted:
                task.cancel()

    def left(self) -> None:
        """The engine's loop ends: nothing can be asked of it any more."""
        with self._lock:
            self._loop = None

    def stop(self, act: Callable[[], None]) -> None:
        """Have `act` run in the engine's loop now; from any thread, in any state, any number of times."""
        with self._lock:
            self._stop_wanted = True
            if self._loop is None or self._state in FINAL:
                return
            if self._state != State.STOPPING and not self._closing:
                self._set(State.STOPPING)
            self._loop.call_soon_threadsafe(act)

    def pause(self) -> None:
        """Pause before the next step; from any thread."""
        with self._lock:
            self._pause_wanted = True
            if self._state == State.RUNNING:
                self._set(State.PAUSING)

    def resume(self) -> None:
        """Go on after a pause, or forget one that has not begun; from any thread."""
        with self._lock:
            self._pause_wanted = False
            if self._state == State.PAUSING:
                self._set(State.RUNNING)
            self._wake()

    def park(self) -> None:
        """End the run before the next step; from any thread."""
        with self._lock:
            self._park_wanted = True
            self._wake()

    async def pause_point(self) -> None:
        """Between two steps: wait here while paused."""
        with self._lock:
            if self._state != State.PAUSING:
                return
            self._set(State.PAUSED)
        self._doing("paused")
        while self._pause_wanted and not self._park_wanted:
            self._go_on.clear()
            await self._go_on.wait()
        self.move_to(State.RUNNING)

    def running(self) -> State:
        """The state to go on in."""
        return State.PAUSING if self._pause_wanted else State.RUNNING

    def move_to(self, new: State) -> None:
        """Change the state. Raises `CancelledError` where the stop key was faster than this step."""
        with self._lock:
            self._refuse_after_a_stop()
            if new is not self._state:  # one question after another
                self._set(new)

    def begin_closing(self) -> None:
        """From here on a stop ends nothing: it would lose the merge. Raises `CancelledError` where it was faster."""
        with self._lock:
            self._refuse_after_a_stop()
            self._closing = True

    def end(self, state: State) -> None:
        """The run is over."""
        with self._lock:
            if state is State.STOPPED and self._state is not State.STOPPING:
                self._set(State.STOPPING)
            self._set(state)

    def _refuse_after_a_stop(self) -> None:
        if self._state == State.STOPPING:
            raise asyncio.CancelledError

    def _wake(self) -> None:
        if self._loop is not None and self._state not in FINAL:
            self._loop.call_soon_threadsafe(self._go_on.set)

    def _set(self, new: State) -> None:
        check_transition(self._state, new)
        self._state = new
