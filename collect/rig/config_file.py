"""Configuration files: the base model of a table, reading a file, and one-line errors for wrong values."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from brushloop.collect.errors import ConfigError
from brushloop.drivers.limits import MOST
from brushloop.sessions.disk import read_bounded
from brushloop.sessions.errors import InputError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Positive = Annotated[float, Field(gt=0.0, le=MOST, allow_inf_nan=False)]
PaperSide = Annotated[float, Field(ge=2.0, le=2000.0, allow_inf_nan=False)]
"""Width or height of a sheet or a patch in mm: at most a million patches fit on a sheet."""


class Config(BaseModel):
    """Base: frozen, extra keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


MAX_BYTES = 8 * 1024 * 1024
"""Most that a file of a person may hold: far more than the longest protocol."""


def read_text(path: Path, max_bytes: int = MAX_BYTES, encoding: str = "utf-8") -> str:
    """The text of a plain file. Raises `ConfigError` that names the file."""
    try:
        # Line ends of any system, as in a file opened as text.
        return re.sub("\r\n?", "\n", read_bounded(path, max_bytes).decode(encoding))
    except InputError as error:
        raise ConfigError(path, "", error.what) from None
    except UnicodeDecodeError as error:
        raise ConfigError(path, "", f"is not UTF-8 at byte {error.start}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file. Raises `ConfigError` that names the file."""
    try:
        return tomllib.loads(read_text(path))
    except ValueError as error:  # also for a number of thousands of digits
        raise ConfigError(path, "", f"is not TOML: {error}") from None
    except RecursionError:
        raise ConfigError(path, "", "is not TOML: nested too deeply") from None


def refusal(
    path: Path, error: ValidationError, of: object, *, environment: Mapping[tuple[str, ...], str] | None = None
) -> ConfigError:
    """The first error in one line. An unknown key comes first, because it is often a missing key misspelt.

    `of` is the model, or the union of models. `environment` maps each path to the variable that sets it: an error in
    such a value names the variable.
    """
    errors = error.errors()
    first = min(errors, key=lambda e: e["type"] != "extra_forbidden")
    models, loc = located(of, first["loc"])
    what = _what(first, models)
    if first["type"].startswith("union_tag"):
        loc.append("kind")
    more = f"; errors besides this one: {len(errors) - 1}" if len(errors) > 1 else ""
    where: Path | str = path
    for set_at, variable in (environment or {}).items():
        if tuple(loc[: len(set_at)]) == set_at and all(isinstance(part, int) for part in loc[len(set_at) :]):
            where = f"environment variable {variable}"
        elif tuple(loc) == set_at[: len(loc)] and set_at[-1] in what:
            more += f"; the environment sets {variable}"
    return ConfigError(where, ".".join(str(part) for part in loc), what + more)


def _what(first: ErrorDetails, models: Sequence[type[BaseModel]]) -> str:
    """What is wrong in a table of these models."""
    match first["type"]:
        case "extra_forbidden":
            known = list(dict.fromkeys(name for model in models for name in model.model_fields))
            meant = next(iter(difflib.get_close_matches(str(first["loc"][-1]), known, n=1)), None)
            hint = f"known are {', '.join(known)}" if meant is None else f"did you mean {meant}?"
            return f"unknown field; {hint}"
        case "union_tag_not_found":
            return f"is missing: one of {', '.join(map(repr, kinds(models)))}"
        case "union_tag_invalid":
            context = first.get("ctx", {})
            return f"{context['tag']!r} is not one of {context['expected_tags']}"
        case "missing" | "value_error":
            return first["msg"].removeprefix("Value error, ")
        case _:
            shown = repr(first["input"])
            return f"{first['msg']} (given: {shown if len(shown) <= 80 else shown[:77] + '...'})"


def located(of: object, loc: Sequence[str | int]) -> tuple[list[type[BaseModel]], list[str | int]]:
    """The models of the innermost known table at an error location of pydantic, and the location as the file has it.

    `of` is a model, or a union of models. pydantic puts the tag of a union in front of the names of its fields.
    """
    models, path = list(_models(of)), list[str | int]()
    for part in loc:
        if chosen := [model for model in models if part in kinds([model])]:
            models = chosen
            continue
        path.append(part)
        inside = [model.model_fields[str(part)].annotation for model in models if part in model.model_fields]
        models = [model for annotation in inside for model in _models(annotation)] or models
    return models, path


def kinds(models: Sequence[type[BaseModel]]) -> list[str]:
    """Values that `kind` may have in these tables."""
    tags = (model.model_fields["kind"].annotation for model in models if "kind" in model.model_fields)
    return [str(kind) for tag in tags for kind in get_args(tag)]


def _models(annotation: object) -> Iterator[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(cast("type[Any]", annotation), BaseModel):
        yield annotation
    for inner in get_args(annotation):
        yield from _models(inner)
