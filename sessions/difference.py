"""Differences between the configuration that a session was started with and another one, field by field."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from brushloop.sessions.disk import MAX_SNAPSHOT_BYTES, read_bounded
from brushloop.sessions.errors import InputError

ABSENT = object()
"""Placeholder for the value of a field that one of the two configurations does not have."""


@dataclass(frozen=True, slots=True)
class Difference:
    """One changed field, or a whole list if its length changed; `field` is empty if the file cannot be compared."""

    file: str
    field: tuple[str, ...]
    """Path of the field in the file: names, and indices of list items from 0."""
    old: Any
    new: Any

    def __str__(self) -> str:
        """Text such as `paper.cell_mm: [80.0, 80.0] -> [40.0, 24.0]`."""
        if not self.field:
            return "its earlier content is missing or damaged"
        return f"{'.'.join(self.field)}: {_short(self.old)} -> {_short(self.new)}"


def differences(folder: Path, snapshots: Mapping[str, str]) -> list[Difference]:
    """Compare the session's JSON files with `snapshots` (file name -> text); empty if nothing changed."""
    found: list[Difference] = []
    for name, text in snapshots.items():
        try:
            old = json.loads(read_bounded(folder / name, MAX_SNAPSHOT_BYTES))
        except (InputError, ValueError, RecursionError):
            found.append(Difference(name, (), ABSENT, ABSENT))
        else:
            found += _compared(name, (), old, json.loads(text))
    return found


def _compared(file: str, at: tuple[str, ...], old: Any, new: Any) -> Iterator[Difference]:
    if isinstance(old, dict) and isinstance(new, dict):
        before, after = cast("dict[str, Any]", old), cast("dict[str, Any]", new)
        for name in {**after, **before}:
            yield from _compared(file, (*at, name), before.get(name, ABSENT), after.get(name, ABSENT))
    elif len(before := _tables(old)) == len(after := _tables(new)) > 0:
        for number, (one, other) in enumerate(zip(before, after, strict=True)):
            yield from _compared(file, (*at, str(number)), one, other)
    elif old != new:
        yield Difference(file, at, old, new)


def _tables(value: Any) -> list[Any]:
    """Items of a list of tables; an empty list for any other value."""
    items = cast("list[Any]", value) if isinstance(value, list) else []
    return items if any(isinstance(item, dict) for item in items) else []


def _short(value: Any) -> str:
    if value is ABSENT:
        return "missing"
    if value is None:
        return "left out"
    if items := _tables(value):
        return f"{len(items)} items" if len(items) > 1 else "1 item"
    if isinstance(value, dict):
        return "given"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else f"{text[:37]}..."
