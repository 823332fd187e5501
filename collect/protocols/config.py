"""Reads `protocol.toml`, a frozen union by `kind`, and its CSV files, whose rows become part of it.

Bad input is refused in one line: file, line, field, allowed range. A new kind is a subclass of `ProtocolBase` in a
module of its own, and a member of `ProtocolConfig`.
"""

from __future__ import annotations

import contextlib
import csv
import io
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast, get_args

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.kinds import (
    MAX_POINTS,
    CalibrationConfig,
    FewStrokesConfig,
    GridConfig,
    ListConfig,
    PointRow,
    ReplayConfig,
    WriteConfig,
)
from brushloop.collect.protocols.plan import MAX_STROKES, ProtocolBase
from brushloop.collect.rig.config_file import EARLIER_NAMES, read_text, read_toml, refusal
from brushloop.sessions.disk import as_text, number

MAX_PROTOCOL_BYTES = 4 * 1024 * 1024
MAX_EFFECTIVE_BYTES = 64 * 1024 * 1024
ProtocolConfig = GridConfig | FewStrokesConfig | ListConfig | ReplayConfig | WriteConfig | CalibrationConfig
TaggedProtocol = Annotated[ProtocolConfig, Field(discriminator="kind")]
_PROTOCOL: TypeAdapter[ProtocolConfig] = TypeAdapter(TaggedProtocol)
_KINDS: dict[str, type[ProtocolBase]] = {
    kind: model for model in get_args(ProtocolConfig) for kind in get_args(model.model_fields["kind"].annotation)
}


def load_protocol(path: Path) -> ProtocolConfig:
    """Read `protocol.toml` with its side files, or the `.json` that a session keeps. Raises `ConfigError`."""
    if path.suffix == ".json":
        try:
            return _PROTOCOL.validate_json(read_text(path, MAX_EFFECTIVE_BYTES))
        except ValidationError as error:
            raise refusal(path, error, TaggedProtocol, tagged=True) from None
    values = _renamed(path, read_toml(path, MAX_PROTOCOL_BYTES))
    for name in ("presses", "points", "ignored_columns"):
        if name in values and "file" in values:
            raise ConfigError(path, name, "a file is named too: give only one of the two")
    kind = _KINDS.get(str(values.get("kind")))
    if kind is WriteConfig:
        _fill_strokes(path, values)
    elif kind is not None and kind.row is not None and "file" in values:
        rows, ignored = read_rows(
            path, "file", values["file"], kind.row, MAX_STROKES, ignore_others=kind.ignores_columns
        )
        values["presses"] = rows
        if kind.ignores_columns:
            values["ignored_columns"] = ignored
    try:
        return _PROTOCOL.validate_python(values)
    except ValidationError as error:
        raise refusal(path, error, TaggedProtocol, tagged=True) from None


def _renamed(path: Path, value: Any) -> Any:
    """The values of a file with `EARLIER_NAMES` replaced. Raises `ConfigError` for a field under both names."""
    if isinstance(value, list):
        return [_renamed(path, item) for item in cast("list[Any]", value)]
    if not isinstance(value, dict):
        return value
    table = cast("dict[str, Any]", value)
    for earlier, name in EARLIER_NAMES.items():
        if earlier in table and name in table:
            raise ConfigError(path, name, f"is given twice, also as {earlier}")
    return {EARLIER_NAMES.get(name, name): _renamed(path, item) for name, item in table.items()}


def _fill_strokes(path: Path, values: dict[str, Any]) -> None:
    """Read the points of a `write` protocol from its files. Values of another shape are left to validation."""
    left = MAX_POINTS
    for i, figure in enumerate(_tables(values.get("figures"))):
        for k, stroke in enumerate(_tables(figure.get("strokes"))):
            if "file" not in stroke:
                continue
            field = f"figures.{i}.strokes.{k}.file"
            if "points" in stroke:
                raise ConfigError(path, field, "points are given too: give only one of the two")
            rows, _ = read_rows(path, field, stroke["file"], PointRow, left)
            stroke["points"] = [row.point for row in rows]
            left -= len(rows)


def _tables(value: object) -> list[dict[str, Any]]:
    if not isinstance(value, list):
        return []
    return [item for item in value if isinstance(item, dict)]  # pyright: ignore[reportUnknownVariableType]


MAX_TABLE_BYTES = 4 * 1024 * 1024
_R = TypeVar("_R", bound=BaseModel)


def read_rows(
    protocol: Path, field: str, name: object, row: type[_R], at_most: int, *, ignore_others: bool = False
) -> tuple[tuple[_R, ...], tuple[str, ...]]:
    """Return (rows, names of the ignored columns) of the CSV file `name` in the folder of `protocol`.

    The first line names the columns; an empty cell counts as left out. `field` is where the protocol names the file.
    Raises `ConfigError`.
    """
    if not isinstance(name, str) or not name or Path(name).name != name or not name.isprintable() or "\\" in name:
        raise ConfigError(protocol, field, f"must be the plain name of a file next to it (given: {name!r:.80})")
    path = protocol.parent / name
    lines = csv.reader(io.StringIO(read_text(path, MAX_TABLE_BYTES, "utf-8-sig"), newline=""), strict=True)
    rows: list[_R] = []
    try:
        columns = [EARLIER_NAMES.get(cell.strip(), cell.strip()) for cell in next(lines, list[str]())]
        for column in columns:
            if columns.count(column) > 1:
                raise ConfigError(path, "line 1", f"the column {column!r:.80} occurs twice")
        used = row.model_fields if ignore_others else columns
        for cells in filter(None, lines):
            line = f"line {lines.line_num}"
            if len(rows) == at_most:
                raise ConfigError(path, line, f"more than {at_most} rows")
            if len(cells) != len(columns):
                raise ConfigError(path, line, f"{len(cells)} cells under {len(columns)} columns")
            texts = {column: as_text(cell.strip()) for column, cell in zip(columns, cells, strict=True)}
            values = {column: _value(column, text) for column, text in texts.items() if column in used and text}
            try:
                rows.append(row.model_validate(values, strict=True))
            except ValidationError as error:
                refused = refusal(path, error, row)
                raise ConfigError(path, f"{line}: {refused.field}", refused.what) from None
    except csv.Error as error:
        raise ConfigError(path, f"line {lines.line_num}", f"is not CSV: {error}") from None
    if not rows:
        raise ConfigError(path, "", "has no rows")
    return tuple(rows), tuple(column for column in columns if column not in row.model_fields)


def _value(column: str, cell: str) -> str | float:
    """The number in a cell; as text where it is none, which validation refuses in every other column."""
    with contextlib.suppress(ValueError):
        return cell if column == "stroke_id" else number(cell)
    return cell
