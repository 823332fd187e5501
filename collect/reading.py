"""Configuration files from disk: bounded, text, TOML; and what pydantic refuses, in one line."""

from __future__ import annotations

import stat
import tomllib
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from collect.errors import ConfigError


def read_text(path: Path, max_bytes: int, encoding: str = "utf-8") -> str:
    """The text of a plain file. Raises `ConfigError` that names the file."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(path, "", "is not a file")
        if status.st_size > max_bytes:
            raise ConfigError(path, "", f"is larger than {max_bytes} bytes")
        return path.read_text(encoding=encoding)
    except FileNotFoundError:
        raise ConfigError(path, "", "no such file") from None
    except OSError as error:
        raise ConfigError(path, "", error.strerror or str(error)) from None
    except UnicodeDecodeError as error:
        raise ConfigError(path, "", f"is not UTF-8 at byte {error.start}") from None


def read_toml(path: Path, max_bytes: int) -> dict[str, Any]:
    """The tables of a TOML file. Raises `ConfigError` that names the file."""
    try:
        return tomllib.loads(read_text(path, max_bytes))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(path, "", f"is not TOML: {error}") from None
    except RecursionError:
        raise ConfigError(path, "", "is not TOML: nested too deeply") from None


def refusal(path: Path, error: ValidationError, *, tagged: bool = False) -> ConfigError:
    """The first thing that is wrong, in one line; an unknown key first: it is often the misspelt name of another.

    `tagged`: the model is a union, whose tag pydantic puts in front of each field's name.
    """
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    loc = [str(part) for part in first["loc"][1 if tagged else 0 :]]
    about_tag = first["type"].startswith("union_tag")
    if tagged and not loc and about_tag:
        loc = ["kind"]
    shown = repr(first["input"])
    shown = shown if len(shown) <= 80 else shown[:77] + "..."
    given = "" if about_tag or first["type"] in ("missing", "value_error") else f" (given: {shown})"
    more = f"; and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    return ConfigError(path, ".".join(loc), first["msg"].removeprefix("Value error, ") + given + more)
