"""Pages that are made from the code: hooks of mkdocs for `make docs`, and docs/exit-codes.md (`python -m bench.pages`).

The reference pages show every command with its options, and every field of `rig.toml` and `protocol.toml`.
"""

from __future__ import annotations

import ast
import html
import inspect
import itertools
import posixpath
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import typer
from mkdocs.structure.files import File, Files
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from typer.cli import get_docs_for_click

from brushloop.__main__ import EXIT_CODES

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "exit-codes.md"
OUTSIDE = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "SECURITY.md": "security.md"}
"""Pages of the repository's root, and their names on the site."""
LINK = re.compile(r"\[([^\]]*)\]\((?!\w+:|#)([^)#\s]*)(#[^)\s]*)?\)")
NAMES = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that are made here."""
    made = {
        "reference/commands.md": commands(),
        "reference/rig.md": rig(),
        "reference/protocol.md": protocol(),
        **{name: (ROOT / origin).read_text(encoding="utf-8") for origin, name in OUTSIDE.items()},
    }
    for name, content in made.items():
        files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown: str, *, page: Any, files: Files, **_: Any) -> str:
    """Point links to where pages lie on the site; what is only in the repository becomes its name."""
    source = page.file.src_uri
    origin = next((outside for outside, name in OUTSIDE.items() if name == source), f"docs/{source}")

    def moved(found: re.Match[str]) -> str:
        text, target, anchor = found[1], found[2], found[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(origin), target))
        if not (ROOT / path).exists():
            return found[0]  # mkdocs reports it
        name = OUTSIDE.get(path, path.removeprefix("docs/") if path.startswith("docs/") else "")
        if files.get_file_from_path(name) is None:
            return f"{text} (`{path}` in the repository)"
        return f"[{text}]({posixpath.relpath(name, posixpath.dirname(source) or '.')}{anchor})"

    return LINK.sub(moved, markdown)


def commands() -> str:
    """Page with every command, its arguments and its options, as typer writes it."""
    import brushloop.__main__

    root: Any = typer.main.get_command(brushloop.__main__.app)
    return _safe(get_docs_for_click(obj=root, ctx=typer.Context(root), name="brushloop", title="Commands"))


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


def exit_codes() -> str:
    """The page about exit codes."""
    codes = [f"| {code} | {meaning} |" for code, meaning in EXIT_CODES.items()]
    intro = (
        "Every command ends with one of these codes. An error is reported in one line that names the file, the field "
        "and the allowed range. The classes of errors [in Python](python.md#errors) have their code in `exit_code`. "
        "This page is written by `python -m bench.pages`."
    )
    return "\n".join(["# Exit codes", intro, "", "| code | meaning |", "|---|---|", *codes, ""])


if __name__ == "__main__":
    PAGE.write_text(exit_codes(), encoding="utf-8")
