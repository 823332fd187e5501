"""Errors of calibration and validation.

InputError                  of `brushloop.sessions`
 +-- CalibrationError       the captures or files do not allow the requested result; says which and why
      +-- CaptureRefused    one capture cannot be used: blank, cut, no contrast; named in every report
"""

from __future__ import annotations

from typing import ClassVar

from brushloop.sessions.errors import InputError


class CalibrationError(InputError):
    """The captures or files do not allow the requested result."""


class StrokesLeftOut(Exception):
    """Strokes could not be used, and are named in what was printed; everything else is done and written."""

    exit_code: ClassVar[int] = 3


class CaptureRefused(CalibrationError):
    """This capture cannot be compared; it is listed by name, never dropped silently."""
