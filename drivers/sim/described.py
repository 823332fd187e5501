"""What is wrong with a file or a request for the simulator, in one line."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from pydantic import ValidationError


class SimFileError(Exception):
    """A file or socket cannot be used, read or written: path, field, what is allowed."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path, field: str, what: str) -> None:
        self.path = path
        self.field = field
        self.what = what
        super().__init__(f"{path}: {field}: {what}" if field else f"{path}: {what}")


def complaint(error: ValidationError) -> tuple[str, str]:
    """(field, what is wrong with it), one line; an unknown key first, as it is often a misspelt one."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    field = ".".join(str(part) for part in first["loc"])
    given = "" if first["type"] in ("missing", "value_error") else f" (given: {str(first['input'])[:60]!r})"
    more = f"; and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    return _plain(field), _plain(f"{first['msg'].removeprefix('Value error, ')}{given}{more}")


def _plain(text: str) -> str:
    """One printable line, whatever the file holds."""
    return "".join(char if char.isprintable() else "?" for char in text)[:300]
