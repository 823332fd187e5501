"""What an operator asks of a run by key: noted at once, granted at the next moment at which the arm may heed it."""

from __future__ import annotations

import threading
from enum import StrEnum


class Wish(StrEnum):
    """One request; the same key again takes it back."""

    RETAKE = "press this stroke again"
    SKIP = "leave this stroke out"
    NEW_SHEET = "put a new sheet in"
    JOG = "find the paper again by jog"

    @property
    def short(self) -> str:
        """Its key's name."""
        return self.name.lower().replace("_", " ")


class Wishes:
    """Asked for from any thread, granted by the engine's."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._open: set[Wish] = set()

    @property
    def open(self) -> tuple[Wish, ...]:
        """What still waits."""
        with self._lock:
            return tuple(wish for wish in Wish if wish in self._open)

    def toggle(self, wish: Wish) -> bool:
        """Ask for it, or take it back; True where it now waits. Retake and skip exclude each other."""
        with self._lock:
            if wish in self._open:
                self._open.remove(wish)
                return False
            if wish in (Wish.RETAKE, Wish.SKIP):
                self._open -= {Wish.RETAKE, Wish.SKIP}
            self._open.add(wish)
            return True

    def take(self, wish: Wish) -> bool:
        """Whether it waits; it does not any more."""
        with self._lock:
            if wish not in self._open:
                return False
            self._open.remove(wish)
            return True
