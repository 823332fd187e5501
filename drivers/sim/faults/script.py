"""`faults.toml`: `[[fault]]` tables, read once before the rig starts."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drivers.sim.faults.vocabulary import Fault

MAX_BYTES = 256 * 1024


class FaultScriptError(Exception):
    """The script cannot be used: file, field, what is allowed."""

    exit_code: ClassVar[int] = 2

    def __init__(self, path: Path, field: str, what: str) -> None:
        self.path = path
        self.field = field
        self.what = what
        super().__init__(f"{path}: {field}: {what}" if field else f"{path}: {what}")


class _Script(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    fault: list[Fault] = Field(default_factory=list[Fault], max_length=1000)


def load_faults(path: Path) -> tuple[Fault, ...]:
    """Read the script. Raises `FaultScriptError` naming file, field and range."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise FaultScriptError(path, "", f"is larger than {MAX_BYTES} bytes")
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FaultScriptError(path, "", "no such file") from None
    except OSError as error:
        raise FaultScriptError(path, "", error.strerror or str(error)) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FaultScriptError(path, "", f"is not TOML: {error}") from None
    try:
        return tuple(_Script.model_validate(values).fault)
    except ValidationError as error:
        raise FaultScriptError(path, *complaint(error)) from None


def hang_script(path: Path, hang: Callable[[Fault], int], faults: Iterable[Fault]) -> None:
    """Hang all of a script. Raises `FaultScriptError` for a fault of a device that the rig does not have."""
    for index, fault in enumerate(faults):
        try:
            hang(fault)
        except ValueError as error:
            raise FaultScriptError(path, f"fault.{index}", str(error)) from None


def fault_of(values: dict[str, Any]) -> Fault:
    """One fault from what a client said. Raises ValueError with one line that names the field."""
    try:
        return Fault.model_validate(values)
    except ValidationError as error:
        field, what = complaint(error)
        raise ValueError(f"{field}: {what}" if field else what) from None


def complaint(error: ValidationError) -> tuple[str, str]:
    """(field, what is wrong with it), one line; an unknown key first, as it is often a misspelt one."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    field = ".".join(str(part) for part in first["loc"])
    given = "" if first["type"] in ("missing", "value_error") else f" (given: {str(first['input'])[:60]!r})"
    more = f"; and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    return _plain(field), _plain(f"{first['msg'].removeprefix('Value error, ')}{given}{more}")


def _plain(text: str) -> str:
    """One printable line, whatever keys somebody made up."""
    return "".join(char if char.isprintable() else "?" for char in text)[:300]
