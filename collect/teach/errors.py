"""Errors that end the first day."""

from __future__ import annotations

from typing import ClassVar


class CannotTeach(Exception):
    """What was taught contradicts itself or cannot be used; `way_out` says what to do. Nothing was written or moved."""

    exit_code: ClassVar[int] = 4

    def __init__(self, what: str, way_out: str) -> None:
        self.what = what
        self.way_out = way_out
        super().__init__(f"{what} {way_out}")
