"""Errors of calibration and validation.

InputError                  of `brushloop.sessions`
 +-- CalibrationError       the captures or files do not allow the requested result; says which and why
      +-- CaptureRefused    one capture cannot be used: blank, cut, no contrast; named in every report
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from brushloop.sessions.errors import InputError

if TYPE_CHECKING:
    from pydantic import ValidationError


class CalibrationError(InputError):
    """The captures or files do not allow the requested result."""


PLAIN = {"json_invalid": "is not JSON: give a file that brushloop wrote", "extra_forbidden": "unknown field"}
"""What is said where pydantic's own words are a riddle to whoever named the wrong file."""


def invalid(where: str, error: ValidationError) -> CalibrationError:
    """An error for the first invalid field of a file, in one line that names the field."""
    first = error.errors()[0]
    field = ".".join(map(str, first["loc"]))
    message = PLAIN.get(first["type"], first["msg"])
    return CalibrationError(where, f"{field}: {message}" if field else message)


class StrokesLeftOut(Exception):
    """Strokes could not be used, and are named in what was printed; everything else is done and written."""

    exit_code: ClassVar[int] = 3


class CaptureRefused(CalibrationError):
    """This capture cannot be compared; it is listed by name, never dropped silently."""
