"""The engine's states and the only ways between them."""

from __future__ import annotations

from enum import StrEnum


class State(StrEnum):
    """What the engine is doing."""

    IDLE = "idle"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    RECOVERING = "recovering"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"
    DONE = "done"


TRANSITIONS: dict[State, frozenset[State]] = {
    State.IDLE: frozenset({State.RECOVERING, State.STOPPING, State.FAILED}),
    State.RECOVERING: frozenset({State.RUNNING, State.PAUSING, State.STOPPING, State.FAILED}),
    State.RUNNING: frozenset({State.PAUSING, State.RECOVERING, State.STOPPING, State.DONE, State.FAILED}),
    State.PAUSING: frozenset({State.PAUSED, State.RUNNING, State.RECOVERING, State.STOPPING, State.DONE, State.FAILED}),
    State.PAUSED: frozenset({State.RUNNING, State.STOPPING, State.FAILED}),
    State.STOPPING: frozenset({State.STOPPED, State.FAILED}),
    State.STOPPED: frozenset(),
    State.FAILED: frozenset(),
    State.DONE: frozenset(),
}
"""`recovering` covers the first retreat of a process and the lift after a step that failed."""

FINAL = frozenset({State.STOPPED, State.FAILED, State.DONE})


class IllegalTransition(Exception):
    """The engine tried a way that the table does not have: a defect."""


def check_transition(old: State, new: State) -> None:
    """Raise `IllegalTransition` where the table has no such way."""
    if new not in TRANSITIONS[old]:
        raise IllegalTransition(f"{old} -> {new}")
