"""Reads `protocol.toml`, a frozen union by `kind`, and its CSV files, whose rows become part of it.

Bad input is refused in one line: file, line, field, allowed range. A new kind is a subclass of `ProtocolBase` in a
module of its own, and a member of `ProtocolConfig`.
"""

from __future__ import annotations

import contextlib
import csv
import io
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.kinds import (
    MAX_STROKE_POINTS,
    MAX_STROKES,
    CalibrationConfig,
    FewStrokesConfig,
    GridConfig,
    ListConfig,
    PointRow,
    ProtocolBase,
    ReplayConfig,
    WriteConfig,
)
from brushloop.collect.rig.config_file import read_text, read_toml, refusal
from brushloop.sessions.disk import as_text, number

MAX_PROTOCOL_BYTES = 4 * 1024 * 1024
MAX_EFFECTIVE_BYTES = 64 * 1024 * 1024
MAX_TABLE_BYTES = 4 * 1024 * 1024
ProtocolConfig = GridConfig | FewStrokesConfig | ListConfig | ReplayConfig | WriteConfig | CalibrationConfig
TaggedProtocol = Annotated[ProtocolConfig, Field(discriminator="kind")]
_PROTOCOL: TypeAdapter[ProtocolConfig] = TypeAdapter(TaggedProtocol)
_KINDS: dict[str, type[ProtocolBase]] = {
    kind: model for model in get_args(ProtocolConfig) for kind in get_args(model.model_fields["kind"].annotation)
}
_R = TypeVar("_R", bound=BaseModel)


def load_protocol(path: Path) -> ProtocolConfig:
    """Read `protocol.toml` with its side files, or the `.json` that a session keeps. Raises `ConfigError`."""
    if not path.exists():
        raise ConfigError(path, "", "no such file: --protocol names another one, such as examples/protocol.toml")
    try:
        if path.suffix == ".json":
            return _PROTOCOL.validate_json(read_text(path, MAX_EFFECTIVE_BYTES))
        values = read_toml(path, MAX_PROTOCOL_BYTES)
        if "robot" in values and "kind" not in values:
            raise ConfigError(path, "", "is a rig, not a protocol: give it to --config, and the protocol to --protocol")
        kind = _KINDS.get(str(values.get("kind")))
        if kind is WriteConfig:
            for i, figure in enumerate(_tables(values.get("figures"))):
                for k, stroke in enumerate(_tables(figure.get("strokes"))):
                    if "file" in stroke:
                        place = f"figures.{i}.strokes.{k}."
                        rows = _rows_of(path, stroke, "points", PointRow, MAX_STROKE_POINTS, place)
                        stroke["points"] = [row.point for row in rows]
        if kind is not None and kind.row is not None and "file" in values:
            values["presses"] = _rows_of(path, values, "presses", kind.row, MAX_STROKES)
        return _PROTOCOL.validate_python(values)
    except ValidationError as error:
        raise refusal(path, error, TaggedProtocol) from None


def _rows_of(
    path: Path, table: dict[str, Any], name: str, row: type[_R], at_most: int, place: str = ""
) -> tuple[_R, ...]:
    """The rows of the CSV file that a table of the protocol names instead of giving the field `name`.

    `place` is where the table lies in the protocol. Raises `ConfigError`.
    """
    if name in table:
        raise ConfigError(path, f"{place}{name}", "a file is named too: give only one of the two")
    return read_rows(path, f"{place}file", table["file"], row, at_most)


def _tables(value: object) -> list[dict[str, Any]]:
    if not isinstance(value, list):
        return []
    return [item for item in value if isinstance(item, dict)]  # pyright: ignore[reportUnknownVariableType]


def read_rows(protocol: Path, field: str, name: object, row: type[_R], at_most: int) -> tuple[_R, ...]:
    """Return the rows of the CSV file `name` in the folder of `protocol`.

    The first line names the columns; an empty cell counts as left out. `field` is where the protocol names the file.
    Raises `ConfigError`.
    """
    if not isinstance(name, str) or not name or Path(name).name != name or not name.isprintable() or "\\" in name:
        raise ConfigError(protocol, field, f"must be the plain name of a file next to it (given: {name!r:.80})")
    path = protocol.parent / name
    lines = csv.reader(io.StringIO(read_text(path, MAX_TABLE_BYTES, "utf-8-sig"), newline=""), strict=True)
    rows: list[_R] = []
    try:
        columns = [cell.strip() for cell in next(lines, list[str]())]
        for column in columns:
            if columns.count(column) > 1:
                raise ConfigError(path, "line 1", f"the column {column!r:.80} occurs twice")
        for cells in filter(None, lines):
            line = f"line {lines.line_num}"
            if len(rows) == at_most:
                raise ConfigError(path, line, f"more than {at_most} rows")
            if len(cells) != len(columns):
                raise ConfigError(path, line, f"{len(cells)} cells under {len(columns)} columns")
            texts = {column: as_text(cell.strip()) for column, cell in zip(columns, cells, strict=True)}
            values = {column: _value(column, text) for column, text in texts.items() if text}
            try:
                rows.append(row.model_validate(values, strict=True))
            except ValidationError as error:
                refused = refusal(path, error, row)
                raise ConfigError(path, f"{line}: {refused.field}", refused.what) from None
    except csv.Error as error:
        raise ConfigError(path, f"line {lines.line_num}", f"is not CSV: {error}") from None
    if not rows:
        raise ConfigError(path, "", "has no rows")
    return tuple(rows)


def _value(column: str, cell: str) -> str | float:
    """The number in a cell; as text where it is none, which validation refuses in every other column."""
    with contextlib.suppress(ValueError):
        return cell if column == "stroke_id" else number(cell)
    return cell
