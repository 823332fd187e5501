"""Reads `protocol.toml` and the CSV files that it names. What is wrong is one line: file, field, allowed range."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from collect.errors import ConfigError
from collect.protocols.config import MAX_POINTS, MAX_STROKES, ProtocolConfig, TaggedProtocol
from collect.protocols.rows import PointRow, PressRow, ReplayRow
from collect.protocols.table import read_rows
from collect.rig.config_file import read_toml, refusal

MAX_PROTOCOL_BYTES = 4 * 1024 * 1024

_PROTOCOL: TypeAdapter[ProtocolConfig] = TypeAdapter(TaggedProtocol)


def load_protocol(path: Path) -> ProtocolConfig:
    """Read `protocol.toml` with its side files. Raises `ConfigError`."""
    values = read_toml(path, MAX_PROTOCOL_BYTES)
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
        raise refusal(path, error, TaggedProtocol, tagged=True) from None


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
