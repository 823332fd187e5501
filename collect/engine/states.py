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
    ASKING = "asking"
    STOPPING = "stopping"
    STOPPED = "stopped"
    FAILED = "failed"
    DONE = "done"


TRANSITIONS: dict[State, frozenset[State]] = {
    State.IDLE: frozenset({State.RECOVERING, State.STOPPING, State.FAILED}),
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
"""`recovering` covers the first retreat of a process and the lift after a step that failed; `asking` waits for a
person, with the arm at rest."""

FINAL = frozenset({State.STOPPED, State.FAILED, State.DONE})


class IllegalTransition(Exception):
    """The engine tried a way that the table does not have: a defect."""


def check_transition(old: State, new: State) -> None:
    """Raise `IllegalTransition` where the table has no such way."""
    if new not in TRANSITIONS[old]:
        raise IllegalTransition(f"{old} -> {new}")
