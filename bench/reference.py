"""Reference pages from the code: every command with its options, every field of `rig.toml` and `protocol.toml`."""

from __future__ import annotations

import ast
import html
import inspect
import itertools
import textwrap
from collections.abc import Iterator
from typing import Any, get_args

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

NAMES = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}


def commands() -> str:
    """Page with every command, its arguments and its options."""
    import brushloop.__main__

    root = typer.main.get_command(brushloop.__main__.app)
    intro = (
        "Made from the code: what `--help` says of each command. Exit codes are on [their own page](../exit-codes.md)."
    )
    return "\n\n".join(["# Commands", intro, *_command(root, "brushloop")]) + "\n"


def rig() -> str:
    """Page with every field of `rig.toml`."""
    from brushloop.collect.rig.config import RigConfig

    intro = "Made from the code. What the tables are for is explained in [configuration](../configuration.md)."
    return "\n\n".join(["# Fields of rig.toml", intro, *_model(RigConfig, "")]) + "\n"


def protocol() -> str:
    """Page with every field of each kind of `protocol.toml`."""
    from brushloop.collect.protocols.config import ProtocolConfig

    intro = "Made from the code. What the kinds do is explained in [protocols](../protocols.md)."
    kinds = [part for model in get_args(ProtocolConfig) for part in _model(model, f'kind = "{_kind(model)}"')]
    return "\n\n".join(["# Fields of protocol.toml", intro, *kinds]) + "\n"


def _kind(model: type[BaseModel]) -> str:
    return str(get_args(model.model_fields["kind"].annotation)[0])


def _command(command: Any, path: str) -> Iterator[str]:
    yield f"## {path}"
    yield _safe(inspect.cleandoc(command.help or ""))
    rows = [_option(one) for one in command.params if not getattr(one, "hidden", False) and one.name != "help"]
    rows = [row for row in rows if "completion" not in row]
    if rows:
        yield "\n".join(["| name | values | default | meaning |", "|---|---|---|---|", *rows])
    for name, sub in getattr(command, "commands", {}).items():
        if not sub.hidden:
            yield from _command(sub, f"{path} {name}")


def _option(one: Any) -> str:
    is_argument = not any(word.startswith("-") for word in one.opts)
    name = (one.name or "").upper() if is_argument else ", ".join(one.opts + one.secondary_opts)
    kind = one.type_descriptor.annotation
    values = getattr(kind, "__name__", str(kind)).lower()
    if one.min is not None or one.max is not None:
        values += f" {_end(one.min)} to {_end(one.max)}"
    default = "required" if one.required else "" if one.default is None or callable(one.default) else str(one.default)
    return _row(f"`{name}`", values, default, getattr(one, "help", "") or "")


def _end(value: float | None) -> str:
    return "any" if value is None else f"{value:g}"


def _model(model: type[BaseModel], name: str) -> Iterator[str]:
    texts = _field_texts(model)
    schemas = model.model_json_schema()["properties"]
    plain: list[str] = []
    tables: list[tuple[str, type[BaseModel]]] = []
    for field, info in model.model_fields.items():
        inner = [one for one in _inside(info.annotation) if isinstance(one, type) and issubclass(one, BaseModel)]
        if inner:
            where = field if not name or name.startswith("kind") else f"{name}.{field}"
            tables += [(where, one) for one in inner]
        else:
            plain.append(_row(f"`{field}`", _values(schemas[field]), _default(info), texts.get(field, "")))
    if name:
        yield f"## {name}" if name.startswith("kind") else f"## [{name}]"
        yield _safe(inspect.cleandoc(model.__doc__ or ""))
    if plain:
        yield "\n".join(["| field | values | default | meaning |", "|---|---|---|---|", *plain])
    for where, inner_model in tables:
        yield from _model(inner_model, where)


def _inside(annotation: object) -> Iterator[object]:
    """A type and the types that it is made of."""
    parts = get_args(annotation)
    if not parts:
        yield annotation
    for part in parts:
        yield from _inside(part)


def _values(schema: dict[str, Any]) -> str:
    """Type and limits of a field in words, from its JSON schema."""
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return ", ".join(f"`{one}`" for one in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(_values(one) for one in schema["anyOf"] if one.get("type") != "null")
    if "prefixItems" in schema:
        parts = [_values(one) for one in schema["prefixItems"]]
        return f"{len(parts)} of: {parts[0]}" if len(set(parts)) == 1 else f"[{', '.join(parts)}]"
    if "items" in schema:
        return f"list of: {_values(schema['items'])}"
    ends = {"minimum": "from", "exclusiveMinimum": "more than", "maximum": "to", "exclusiveMaximum": "less than"}
    limits = [f"{word} {schema[end]:g}" for end, word in ends.items() if end in schema]
    return " ".join([NAMES.get(schema.get("type", ""), "table"), *limits])


def _default(info: FieldInfo) -> str:
    if info.is_required():
        return "required"
    return "" if info.default is None else str(info.get_default(call_default_factory=True, validated_data={}))


def _field_texts(model: type[BaseModel]) -> dict[str, str]:
    """The docstrings below the fields of a class and of its bases."""
    texts: dict[str, str] = {}
    for one in reversed(model.__mro__):
        if not issubclass(one, BaseModel) or one.__module__.startswith("pydantic"):
            continue
        [found] = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        body: list[Any] = found.body  # type: ignore[attr-defined]
        for field, text in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                texts[ast.unparse(field.target)] = inspect.cleandoc(str(text.value.value))
    return texts


def _row(*cells: str) -> str:
    return f"| {' | '.join(_safe(' '.join(cell.split())).replace('|', chr(92) + '|') for cell in cells)} |"


def _safe(text: str) -> str:
    """Text that Markdown shows as it is; code in backticks stays code."""
    parts = text.split("`")
    return "`".join(part if k % 2 else html.escape(part, quote=False) for k, part in enumerate(parts))
