"""Reads `protocol.toml`, a frozen union by `kind`, and its CSV files, whose rows become part of it.

Bad input is refused in one line: file, line, field, allowed range. A new kind is a subclass of `StrokesConfig` in a
module of its own, and a member of `ProtocolConfig`.
"""

from __future__ import annotations

import contextlib
import csv
import io
from functools import partial
from pathlib import Path
from typing import Annotated, TypeVar

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.kinds import MAX_STROKES, FewStrokesConfig, GridConfig, ListConfig, WriteConfig
from brushloop.collect.rig.config_file import read_text, read_toml, refusal
from brushloop.sessions.disk import MAX_SNAPSHOT_BYTES, as_text, number

ProtocolConfig = GridConfig | FewStrokesConfig | ListConfig | WriteConfig
TaggedProtocol = Annotated[ProtocolConfig, Field(discriminator="kind")]
_PROTOCOL: TypeAdapter[ProtocolConfig] = TypeAdapter(TaggedProtocol)
_R = TypeVar("_R", bound=BaseModel)


def load_protocol(path: Path) -> ProtocolConfig:
    """Read `protocol.toml` with its side files, or the `.json` that a session keeps. Raises `ConfigError`."""
    if not path.exists():
        raise ConfigError(path, "", "no such file: choose another one (--protocol), such as examples/protocol.toml")
    try:
        if path.suffix == ".json":
            return _PROTOCOL.validate_json(read_text(path, MAX_SNAPSHOT_BYTES))
        values = read_toml(path)
        if "robot" in values and "kind" not in values:
            raise ConfigError(path, "", "is a rig, not a protocol: give it to --config, and the protocol to --protocol")
        return _PROTOCOL.validate_python(values, context=partial(read_rows, path.parent))
    except ValidationError as error:
        raise refusal(path, error, TaggedProtocol) from None


def read_rows(folder: Path, name: object, row: type[_R]) -> list[_R]:
    """Return the rows of the CSV file `name` in the folder of a protocol, at most `MAX_STROKES`.

    The first line names the columns; an empty cell counts as left out. Raises `ConfigError`, and ValueError if `name`
    is none of a file there.
    """
    if not isinstance(name, str) or not name or Path(name).name != name or not name.isprintable() or "\\" in name:
        raise ValueError(f"file: must be the name, without folder, of a file beside the protocol (given: {name!r:.80})")
    path = folder / name
    lines = csv.reader(io.StringIO(read_text(path, encoding="utf-8-sig"), newline=""), strict=True)
    rows: list[_R] = []
    try:
        columns = [cell.strip() for cell in next(lines, list[str]())]
        for column in columns:
            if columns.count(column) > 1:
                raise ConfigError(path, "line 1", f"the column {column!r:.80} occurs twice")
        for cells in filter(None, lines):
            line = f"line {lines.line_num}"
            if len(rows) == MAX_STROKES:
                raise ConfigError(path, line, f"more than {MAX_STROKES} rows")
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
    return rows


def _value(column: str, cell: str) -> str | float:
    """The number in a cell; as text where it is none, which validation refuses in every other column."""
    with contextlib.suppress(ValueError):
        return cell if column == "stroke_id" else number(cell)
    return cell
