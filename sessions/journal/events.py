"""Fields that each event of a journal must have, so that no command reads a line that it cannot use."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, cast

from brushloop.sessions.journal import Line
from brushloop.sessions.names import bare_name

NONSENSE = (KeyError, TypeError, ValueError, OverflowError, AttributeError)
"""Exceptions that a malformed line may cause."""
_SERIAL = re.compile(r"\d{1,9}(?=-)")
MAX_NUMBER = 10**9


def check_event(line: Line) -> None:
    """Raise `ValueError`, naming the field, if one is missing or has an invalid value."""
    event = line["event"]
    required, optional = FIELDS.get(event, ({}, {}))
    for name, check in required.items():
        if name not in line:
            raise ValueError(f"{name!r} of event {event!r} is missing")
        _check(event, name, check, line[name])
    for name, check in {"t_ns": _is_time, **optional}.items():
        if name in line:
            _check(event, name, check, line[name])


def serial_of(line: Line) -> int | None:
    """Serial number at the start of the name of a step's file; None for a line without one."""
    serial = _SERIAL.match(str(line.get("file", "")))
    return int(serial[0]) if serial else None


def _check(event: str, name: str, check: Callable[[Any], str], value: Any) -> None:
    if wrong := check(value):
        raise ValueError(f"{name!r} of event {event!r} {wrong}")


def _is_text(value: Any) -> str:
    return "" if isinstance(value, str) else "is not a string"


def _is_whole(value: Any) -> str:
    whole = isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_NUMBER
    return "" if whole else f"is not a whole number, 0 to {MAX_NUMBER}"


def _is_time(value: Any) -> str:
    return "" if isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63 else "is not a time"


def _is_patch(value: Any) -> str:
    return "" if value is None else _is_whole(value)


def _are_patches(value: Any) -> str:
    patches = cast("list[Any]", value) if isinstance(value, list) else [None]
    return "is not a list of patches" if any(map(_is_whole, patches)) else ""


def _is_number(value: Any) -> str:
    number = value is None or (isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value))
    return "" if number else "is not a number"


def _is_object(value: Any) -> str:
    return "" if isinstance(value, dict) else "is not an object"


def _are_counts(value: Any) -> str:
    counts = cast("dict[str, Any]", value) if isinstance(value, dict) else {"": None}
    return "holds something that is not a count" if any(map(_is_whole, counts.values())) else ""


def _is_step_file(value: Any) -> str:
    wrong = _is_file(value)
    return wrong or ("" if value.endswith(".mcap") else "does not end in .mcap")


def _is_file(value: Any) -> str:
    try:
        bare_name(value)
    except ValueError as error:
        return str(error)
    return ""


def _are_snapshots(value: Any) -> str:
    texts = cast("dict[str, Any]", value) if isinstance(value, dict) else {"": None}
    for name, text in texts.items():
        wrong = _is_file(name) or _is_text(text)
        if wrong or not name.endswith((".toml", ".json")):
            return f"names a file that {wrong or 'is no configuration'}"
    return ""


def _are_values(value: Any) -> str:
    """Check the fields of a step's parameters or result that this package reads."""
    if wrong := _is_object(value):
        return wrong
    values = cast("dict[str, Any]", value)
    for name, check in VALUES.items():
        if name in values and (wrong := check(values[name])):
            return f"holds a {name!r} that {wrong}"
    return ""


Checks = dict[str, Callable[[Any], str]]
VALUES: Checks = {
    "stroke_id": _is_text,
    "still": _is_whole,
    "sheet": _is_whole,
    "depth_mm": _is_number,
    "tilt_deg": _is_number,
}
FIELDS: dict[str, tuple[Checks, Checks]] = {
    "open": ({"header": _is_object}, {"snapshots": _are_snapshots}),
    "begin": (
        {
            "key": _is_text,
            "kind": _is_text,
            "attempt": _is_whole,
            "sheet": _is_whole,
            "patch": _is_patch,
            "file": _is_step_file,
        },
        {"more_patches": _are_patches, "params": _are_values},
    ),
    "done": (
        {
            "key": _is_text,
            "kind": _is_text,
            "file": _is_step_file,
            "sha256": _is_text,
            "counts": _are_counts,
            "result": _are_values,
        },
        {"attempt": _is_whole},
    ),
    "void": ({"key": _is_text, "attempt": _is_whole}, {"why": _is_text}),
    "sheet": ({"sheet": _is_whole}, {}),
    "ended": ({"why": _is_text}, {}),
    "closed": ({}, {"sha256": _is_text, "counts": _are_counts}),
    "repaired": ({"file": _is_step_file, "sha256": _is_text, "counts": _are_counts}, {"missing": _are_counts}),
    "held": ({"file": _is_step_file, "by": _is_text}, {}),
    "lost": ({"file": _is_step_file}, {"why": _is_text}),
    "doubt": ({"sheet": _is_whole}, {"file": _is_file}),
}
"""Required and optional fields of each event."""
