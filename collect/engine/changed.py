"""The refusal to go on with a session whose configuration was another: what differs, and how to go on all the same."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from collect.errors import ConfigError
from collect.rig.config import RigConfig, overrides
from sessions.difference import ABSENT, Difference

FILES = {"rig.effective.json": "rig.toml", "protocol.effective.json": "protocol.toml"}
"""What the user calls the file whose values, the environment and side files included, are compared."""
OPTIONS = {"rig.toml": "--config", "protocol.toml": "--protocol"}
MOST_SHOWN = 5
"""More would push the way out off a screen of 24 lines."""
SIDE_FILE = re.compile(r"^\s*(lens_)?file\s*=|\{\s*file\s*=", re.MULTILINE)


def changed(folder: Path, found: Sequence[Difference], given: dict[str, Path], texts: dict[str, str]) -> ConfigError:
    """What differs, one line each, then what to do.

    `given` and `texts` are where `rig.toml` and `protocol.toml` of this run lie and what they say.
    """
    environment = overrides(RigConfig)
    lines: list[str] = []
    variables: list[str] = []
    for one in found:
        variable = environment.get(one.field) if FILES[one.file] == "rig.toml" else None
        variables += [variable] if variable else []
        lines.append(f"{FILES[one.file]}: {one}{f' (by {variable})' if variable else ''}")
    if len(lines) > MOST_SHOWN:
        lines[MOST_SHOWN - 1 :] = [f"and {len(lines) - MOST_SHOWN + 1} more"]
    differing = {FILES[one.file] for one in found}
    options = [
        _option(folder / name, given[name])
        for name, text in texts.items()
        if name in differing and (folder / name).is_file() and (folder / name).read_text(encoding="utf-8") != text
    ]
    old = " ".join(options)
    if variables:
        old += f"{' ' if old else ''}without {' and '.join(variables)} in the environment"
    if any(_of_this_version(one, found) for one in found):
        old += f"{' ' if old else ''}with the brushloop that began it, whose files had other fields"
    elif not old:
        old = "with the environment, and the files that it names, as they were then"
    way_out = f"Go on with the old one: {old}; or start a new session with --new."
    return ConfigError(folder, "", "\n".join(["was begun with another configuration:", *lines, way_out]))


def _of_this_version(one: Difference, found: Sequence[Difference]) -> bool:
    """Whether only the software differs: only one of the two knows the field, in a table of the same kind."""
    kind = (*one.field[:-1], "kind")
    known = ABSENT not in (one.old, one.new)
    return bool(one.field) and not known and not any((o.file, o.field) == (one.file, kind) for o in found)


def _option(old: Path, given: Path) -> str:
    """The option that takes the old file; one that names other files looks for them beside itself."""
    beside = f" (copied beside {given}: it names other files)" if SIDE_FILE.search(old.read_text("utf-8")) else ""
    return f"{OPTIONS[old.name]} {old}{beside}"
