"""The state of a run, and the requests that any thread may make: to pause, park or stop, and what the operator asks."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from enum import StrEnum

from brushloop.collect.operator import EXCLUSIVE, OperatorRequest


class State(StrEnum):
    """What the engine is doing."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    RECOVERING = "recovering"
    ASKING = "asking"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"
    DONE = "done"


TRANSITIONS: dict[State, frozenset[State]] = {
    State.IDLE: frozenset({State.RECOVERING, State.ASKING, State.STOPPING, State.FAILED}),
    State.RECOVERING: frozenset({State.RUNNING, State.PAUSING, State.ASKING, State.STOPPING, State.FAILED}),
    State.RUNNING: frozenset({State.PAUSING, State.RECOVERING, State.ASKING, State.STOPPING, State.DONE, State.FAILED}),
    State.PAUSING: frozenset(
        {State.PAUSED, State.RUNNING, State.RECOVERING, State.ASKING, State.STOPPING, State.DONE, State.FAILED}
    ),
    State.ASKING: frozenset({State.RECOVERING, State.RUNNING, State.PAUSING, State.STOPPING, State.FAILED}),
    State.PAUSED: frozenset({State.RUNNING, State.STOPPING, State.FAILED}),
    State.STOPPING: frozenset({State.STOPPED, State.FAILED}),
    State.STOPPED: frozenset(),
    State.FAILED: frozenset(),
    State.DONE: frozenset(),
}
"""The states that may follow each state. `recovering` covers the first retreat of a process and the lift after a failed
step; `asking` waits for a person, with the arm at rest."""

FINAL = frozenset({State.STOPPED, State.FAILED, State.DONE})


class RunControl:
    """State of a run and the requests from keys, under one lock. Talks to no device."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._state = State.IDLE
        self._loop: asyncio.AbstractEventLoop | None = None
        self._go_on = asyncio.Event()
        self._stop_wanted = False
        self._pause_wanted = False
        self.park_wanted = False
        """Whether the run is to end before the next step."""
        self.closing = False
        """Whether everything is collected and the arm parked; the run then ends by itself."""
        self.requests: tuple[OperatorRequest, ...] = ()
        """Requests of the operator that are still pending."""

    @property
    def state(self) -> State:
        """What the run is doing."""
        return self._state

    def toggle(self, request: OperatorRequest) -> None:
        """Make or withdraw a request of the operator; from any thread."""
        with self._lock:
            replaced = EXCLUSIVE if request in EXCLUSIVE else {request}
            kept = tuple(each for each in self.requests if each not in replaced)
            self.requests = kept if request in self.requests else (*kept, request)

    def take(self, request: OperatorRequest) -> bool:
        """Remove a request that is about to be carried out; False if it was not made."""
        with self._lock:
            made = request in self.requests
            self.requests = tuple(each for each in self.requests if each is not request)
            return made

    def entered(self, task: asyncio.Task[None]) -> None:
        """Note that this event loop runs `task` until the end; cancel it if a stop was requested before."""
        with self._lock:
            self._loop = asyncio.get_running_loop()
            if self._stop_wanted:
                task.cancel()

    def stop(self, act: Callable[[], None]) -> None:
        """Run `act` in the engine's event loop now; from any thread, in any state, any number of times."""
        with self._lock:
            self._stop_wanted = True
            if self._loop is None or self._state in FINAL:
                return
            if self._state != State.STOPPING and not self.closing:
                self._set(State.STOPPING)
            self._loop.call_soon_threadsafe(act)

    def pause(self) -> None:
        """Pause before the next step, unless the run is to end there; from any thread."""
        with self._lock:
            self._pause_wanted = not self.park_wanted
            if self._pause_wanted and self._state == State.RUNNING:
                self._set(State.PAUSING)

    def resume(self) -> None:
        """Go on after a pause, or cancel one that has not begun; from any thread."""
        with self._lock:
            self._end_pause()

    def park(self) -> None:
        """End the run before the next step; from any thread."""
        with self._lock:
            self.park_wanted = True
            self._end_pause()

    async def pause_point(self) -> None:
        """Wait here, between two steps, while the run is paused."""
        with self._lock:
            if self._state != State.PAUSING:
                return
            self._set(State.PAUSED)
        while True:
            await self._go_on.wait()
            self._go_on.clear()
            with self._lock:
                if not self._pause_wanted:
                    return self._change(State.RUNNING)

    def move_to(self, new: State) -> None:
        """Change the state; a run that is to pause before the next step is pausing, not running.

        Raises `CancelledError` once a stop was requested.
        """
        with self._lock:
            self._change(State.PAUSING if new is State.RUNNING and self._pause_wanted else new)

    def begin_closing(self) -> None:
        """Ignore stops from now on: one would lose the merge. Raises `CancelledError` if one was already requested."""
        with self._lock:
            self._refuse_after_a_stop()
            self.closing = True

    def end(self, state: State) -> None:
        """End the run in a final state."""
        with self._lock:
            if state is State.STOPPED and self._state is not State.STOPPING:
                self._set(State.STOPPING)
            self._set(state)

    def _change(self, new: State) -> None:
        self._refuse_after_a_stop()
        if new is not self._state:  # unchanged if one question follows another
            self._set(new)

    def _refuse_after_a_stop(self) -> None:
        if self._state == State.STOPPING:
            raise asyncio.CancelledError

    def _end_pause(self) -> None:
        self._pause_wanted = False
        if self._state == State.PAUSING:
            self._set(State.RUNNING)
        elif self._state == State.PAUSED and self._loop is not None:
            self._loop.call_soon_threadsafe(self._go_on.set)

    def _set(self, new: State) -> None:
        if new not in TRANSITIONS[self._state]:
            raise RuntimeError(f"{self._state} -> {new} is not in the table of transitions")
        self._state = new
