"""TOML files that describe a brush to the simulator: read completely, or refused with one line."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import ClassVar, TypeVar

from pydantic import BaseModel, ValidationError

MAX_BYTES = 256 * 1024
Described = TypeVar("Described", bound=BaseModel)


class SimFileError(Exception):
    """A file or socket cannot be used, read or written: path, field, what is allowed."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path, field: str, what: str) -> None:
        self.path = path
        self.field = field
        self.what = what
        super().__init__(f"{path}: {field}: {what}" if field else f"{path}: {what}")


def load_described(path: Path, model: type[Described]) -> Described:
    """Read and check the file. Raises `SimFileError`, naming file, field and range."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise SimFileError(path, "", f"is larger than {MAX_BYTES} bytes")
        values = tomllib.loads(data.decode("utf-8"))
    except FileNotFoundError:
        raise SimFileError(path, "", "no such file") from None
    except OSError as error:
        raise SimFileError(path, "", error.strerror or str(error)) from None
    except (ValueError, RecursionError) as error:  # a ValueError also for a number of thousands of digits
        raise SimFileError(path, "", f"is not TOML: {error}") from None
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise SimFileError(path, *complaint(error)) from None


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
