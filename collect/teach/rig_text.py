"""`rig.toml` from the notebook: every value with how it was obtained, how well it is known, and when."""

from __future__ import annotations

import itertools
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from brushloop.calibrate.files import write_whole
from brushloop.collect.rig.config import RigConfig
from brushloop.collect.rig.config_file import refusal
from brushloop.collect.rig.optics import with_optics
from brushloop.collect.teach.store import Notebook, Taught, Value

ASIDE = "aside."
HEAD = "# Made by `brushloop rig new`. Each value: how it was obtained, how well it is known, when."
UNPROVEN = "# NOT PROVEN: `brushloop rig teach proof --arm` has not been run since the last value was taught."
PROVEN = "# Proven by a dry run, a touch, the self-check and a judged press"
UNTRIED = """\
# The software that wrote this file has never been tried on a real cabinet. A difference would show in:
#   framing, ports, modes: step 1 of `brushloop rig new`; flange poses: the residuals of step 3;
#   speeds and stops: the dry run of the last step; forces: the push in the step of the brush."""


def rig_of(notebook: Notebook, rig_path: Path) -> RigConfig:
    """The configuration that the notebook gives, without overrides from the environment. Raises `ConfigError`."""
    try:
        rig = RigConfig.model_validate(_tables(notebook, rig_path))
    except ValidationError as error:
        raise refusal(rig_path, error, RigConfig) from None
    return rig.model_copy(update={"camera": with_optics(rig_path, rig.camera)})


def rig_text(notebook: Notebook, rig_path: Path) -> str:
    """TOML text with comments. Values without a table come first, then table by table."""
    proven = notebook.done.get("proof")
    lines = [HEAD, UNPROVEN if proven is None else f"{PROVEN}, {proven}.", *UNTRIED.splitlines()]
    tables = defaultdict[str, list[tuple[str, Taught | None, Value]]](list)
    for field, value in _flat(notebook, rig_path).items():
        table, _, name = field.rpartition(".")
        tables[table].append((name, notebook.values.get(field), value))
    for table in sorted(tables, key=lambda name: (name != "", name.split(".")[0] != "robot", name)):
        lines += ["", f"[{table}]"] if table else [""]
        for name, taught, value in tables[table]:
            if taught is not None:
                lines += [f"# {line}" for line in _wrapped(taught.comment())]
            lines.append(f"{name} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def write_rig(rig_path: Path, notebook: Notebook) -> tuple[Path, Path | None]:
    """Write `rig.toml`; returns its path, and that of the old file, which is kept. Raises `ConfigError`, OSError."""
    rig_of(notebook, rig_path)
    text, kept = rig_text(notebook, rig_path), None
    if rig_path.exists():
        old = rig_path.read_text(encoding="utf-8")
        if old == text:
            return rig_path, None
        kept = _free_name(rig_path)
        with kept.open("x", encoding="utf-8") as file:
            file.write(old)
    write_whole(rig_path, text)
    return rig_path, kept


def _free_name(path: Path) -> Path:
    """An unused name beside the file."""
    names = (path.with_name(f"{path.name}.bak{number}") for number in ("", *(f"-{n}" for n in itertools.count(2))))
    return next(name for name in names if not name.exists() and not name.is_symlink())


def _flat(notebook: Notebook, rig_path: Path) -> dict[str, Value]:
    """Every field of `rig.toml` by its path."""
    found: dict[str, Value] = {"name": rig_path.stem, "paper.name": "Xuan paper"}
    found |= {field: taught.value for field, taught in notebook.values.items() if not field.startswith(ASIDE)}
    return found


def _tables(notebook: Notebook, rig_path: Path) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for field, value in _flat(notebook, rig_path).items():
        *tables, name = field.split(".")
        at = made
        for table in tables:
            at = at.setdefault(table, {})
        at[name] = _rounded(value)
    return made


def _rounded(value: Value) -> Any:
    """Round a value for the file: no value is known better than 0.001 mm or 0.0001 deg."""
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return round(value, 4) + 0.0 if isinstance(value, float) else value


def _toml(value: Value) -> str:
    """A value as TOML, which writes numbers, strings, lists and booleans as JSON does."""
    return json.dumps(_rounded(value), ensure_ascii=False)


def _wrapped(text: str, width: int = 116) -> list[str]:
    import textwrap

    return textwrap.wrap(text.replace("\n", " "), width)
