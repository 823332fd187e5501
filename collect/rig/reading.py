"""Configuration files from disk: bounded, text, TOML; and what pydantic refuses, in one line."""

from __future__ import annotations

import stat
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from collect.errors import ConfigError
from collect.rig.config_environment import place
from collect.rig.config_names import fields, kinds, models_at, nearest

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


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


def refusal(
    path: Path,
    error: ValidationError,
    of: object,
    *,
    tagged: bool = False,
    environment: Mapping[tuple[str, ...], str] | None = None,
) -> ConfigError:
    """The first thing that is wrong, in one line; an unknown key first: it is often the misspelt name of another.

    `of`: the model, or the union of models. `tagged`: it is a union, whose tag pydantic puts in front of each field's
    name. `environment`: the variable that sets each path; it is named where the value came from there.
    """
    errors = error.errors()
    first = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    what, told = _what(first, errors, of)
    key = first["loc"][-1:] if first["type"] == "extra_forbidden" else ()
    within = first["loc"][1 if tagged else 0 : len(first["loc"]) - len(key)]
    loc = [*(part for part in within if not _is_tag(part)), *key]
    if first["type"].startswith("union_tag"):
        loc.append("kind")
    more = f"; and {len(errors) - told} more" if len(errors) > told else ""
    where: Path | str = path
    for set_at, variable in (environment or {}).items():
        if tuple(loc[: len(set_at)]) == set_at and all(isinstance(part, int) for part in loc[len(set_at) :]):
            where = place(variable)
        elif tuple(loc) == set_at[: len(loc)] and set_at[-1] in what:
            more += f"; the environment sets {variable}"
    return ConfigError(where, ".".join(str(part) for part in loc), what + more)


def _what(first: ErrorDetails, errors: list[ErrorDetails], of: object) -> tuple[str, int]:
    """What is wrong, in words, and how many of the errors they tell."""
    loc = first["loc"]
    match first["type"]:
        case "extra_forbidden":
            kind = "table" if isinstance(first["input"], dict) else "field"
            missing = [str(e["loc"][-1]) for e in errors if e["type"] == "missing" and e["loc"][:-1] == loc[:-1]]
            known = fields(models_at(of, loc[:-1]))
            meant = nearest(str(loc[-1]), missing) or nearest(str(loc[-1]), known)
            if meant is None:
                return f"unknown {kind}; known are {', '.join(known)}", 1
            if meant in missing:
                return f"unknown {kind}; did you mean {meant}, which is missing?", 2
            return f"unknown {kind}; did you mean {meant}?", 1
        case "union_tag_not_found":
            return f"is missing: one of {', '.join(map(repr, kinds(models_at(of, loc))))}", 1
        case "union_tag_invalid":
            context = first.get("ctx", {})
            return f"{context['tag']!r} is not one of {context['expected_tags']}", 1
        case "missing" | "value_error":
            return first["msg"].removeprefix("Value error, "), 1
        case _:
            shown = repr(first["input"])
            return f"{first['msg']} (given: {shown if len(shown) <= 80 else shown[:77] + '...'})", 1


def _is_tag(part: str | int) -> bool:
    """Whether this is the tag of a union within the file, and no field's name: those tags have a hyphen."""
    return isinstance(part, str) and "-" in part
