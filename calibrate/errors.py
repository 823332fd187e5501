"""Errors of calibration and validation.

CalibrationError       the captures do not allow the number that was asked for; says which and why
 +-- CaptureRefused    one capture cannot be used: blank, cut, no contrast; named in every report
"""

from __future__ import annotations

from typing import ClassVar


class CalibrationError(Exception):
    """A number cannot be had from these captures."""

    exit_code: ClassVar[int] = 2

    def __init__(self, where: str, what: str) -> None:
        self.where = where
        self.what = what
        super().__init__(f"{where}: {what}")


class CaptureRefused(CalibrationError):
    """This capture cannot be compared; it is listed by name, never dropped in silence."""
