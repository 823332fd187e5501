"""Reads `protocol.toml` and the CSV files that it names. What is wrong is one line: file, field, allowed range."""

from __future__ import annotations

import stat
import tomllib
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from collect.errors import ConfigError
from collect.protocols.config import MAX_POINTS, MAX_STROKES, ProtocolConfig, TaggedProtocol
from collect.protocols.rows import PointRow, PressRow, ReplayRow
from collect.protocols.table import read_rows

MAX_PROTOCOL_BYTES = 4 * 1024 * 1024

_PROTOCOL: TypeAdapter[ProtocolConfig] = TypeAdapter(TaggedProtocol)


def load_protocol(path: Path) -> ProtocolConfig:
    """Read `protocol.toml` with its side files. Raises `ConfigError`."""
    values = _toml(path)
    for name in ("presses", "points", "ignored_columns"):
        if name in values and "file" in values:
            raise ConfigError(path, name, "a file is named too: one of the two")
    match values.get("kind"):
        case "list" if "file" in values:
            presses, _ = read_rows(path, "file", values["file"], PressRow, MAX_STROKES)
            values["presses"] = presses
        case "replay" if "file" in values:
            presses, ignored = read_rows(path, "file", values["file"], ReplayRow, MAX_STROKES, ignore_others=True)
            values |= {"presses": presses, "ignored_columns": ignored}
        case "write":
            _fill_strokes(path, values)
        case _:
            pass
    try:
        return _PROTOCOL.validate_python(values)
    except ValidationError as error:
        raise refused(path, error) from None


def refused(path: Path, error: ValidationError) -> ConfigError:
    """The first thing that is wrong, in one line; an unknown key first: it is often the misspelt name of another."""
    first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
    # pydantic puts the union's tag in front of each field's name
    loc = [str(part) for part in first["loc"][1:]] or (["kind"] if "union_tag" in first["type"] else [])
    shown = repr(first["input"])
    plain = first["type"] not in ("missing", "value_error") and not first["type"].startswith("union_tag")
    given = f" (given: {shown if len(shown) <= 80 else shown[:77] + '...'})" if plain else ""
    more = f"; and {error.error_count() - 1} more" if error.error_count() > 1 else ""
    return ConfigError(path, ".".join(loc), first["msg"].removeprefix("Value error, ") + given + more)


def _fill_strokes(path: Path, values: dict[str, Any]) -> None:
    """Points from the files of a `write` protocol. Whatever has another shape is left for validation to refuse."""
    left = MAX_POINTS
    for i, figure in enumerate(_tables(values.get("figures"))):
        for k, stroke in enumerate(_tables(figure.get("strokes"))):
            if "file" not in stroke:
                continue
            field = f"figures.{i}.strokes.{k}.file"
            if "points" in stroke:
                raise ConfigError(path, field, "points are given too: one of the two")
            rows, _ = read_rows(path, field, stroke["file"], PointRow, left)
            stroke["points"] = [row.point for row in rows]
            left -= len(rows)


def _tables(value: object) -> list[dict[str, Any]]:
    if not isinstance(value, list):
        return []
    return [item for item in value if isinstance(item, dict)]  # pyright: ignore[reportUnknownVariableType]


def _toml(path: Path) -> dict[str, Any]:
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(path, "", "is not a file")
        if status.st_size > MAX_PROTOCOL_BYTES:
            raise ConfigError(path, "", f"is larger than {MAX_PROTOCOL_BYTES} bytes")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(path, "", "no such file") from None
    except OSError as error:
        raise ConfigError(path, "", error.strerror or str(error)) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(path, "", f"is not TOML: {error}") from None
    except RecursionError:
        raise ConfigError(path, "", "is not TOML: nested too deeply") from None
