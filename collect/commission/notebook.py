"""What has been taught so far: one file beside the future `rig.toml`, written whole after each value; and `rig.toml`.

It holds what was observed (where the flange stood at each thing) and what was found from it, so that a session that
was interrupted asks nothing again, and a value that depends on others is computed again when they change.
"""

from __future__ import annotations

import json
import textwrap
import tomllib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass

from brushloop.calibrate.files import replacing, write_whole
from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.check import Check, unmeasured
from brushloop.collect.rig.config import RigConfig, with_optics
from brushloop.collect.rig.config_file import Config, Finite, read_text, refusal
from brushloop.drivers.arcs.wire import Framing
from brushloop.drivers.devices import Pose
from brushloop.sessions.disk import fsync_folder, set_aside, sync

MAX_BYTES = 1024 * 1024
ENDING, ASIDE = ".taught.json", "aside."
Value = bool | int | float | str | list[Finite] | list[list[Finite]]
"""What a field of `rig.toml` can hold."""
StepName = Literal["arm", "camera", "tip", "sheet", "places", "brush", "force", "limits", "proof"]
"""In the order in which they are taught: the box of the limits needs the deepest press."""
STEPS: tuple[StepName, ...] = get_args(StepName)
UNKNOWN = "not "
"""Beginning of the text for a value that was taken over without a measurement."""
HEAD = "# Made by `brushloop rig new`. Each value: how it was obtained, how well it is known, when."
UNPROVEN = "# NOT PROVEN: `brushloop rig teach proof --arm` has not been run since the last value was taught."
PROVEN = "# Proven by a dry run, a touch, the self-check and a judged press"
UNTRIED = """\
# The software that wrote this file has never been tried on a real cabinet. A difference would show in:
#   framing, ports, modes: step 1 of `brushloop rig new`; flange poses: the residuals of step 3;
#   speeds and stops: the dry run of the last step; forces: the push in the step of the brush."""


def now_utc() -> str:
    """The current time in UTC as text, to the second, as the notebook keeps it."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


@dataclass(frozen=True)
class Taught:
    """The value of one field of `rig.toml`, how it was obtained, and how well it is known."""

    value: Value
    how: str
    """How it was obtained, as a clause."""
    unit: str = ""
    sigma: float | None = None
    """One standard error, in the unit; None where none can be given."""
    known: str = ""
    """How well it is known, in words."""
    at: str = field(default_factory=now_utc)
    """When, in UTC."""

    def comment(self) -> str:
        """One line for `rig.toml`."""
        error = "" if self.sigma is None else f", standard error {self.sigma:.3g} {self.unit}".rstrip()
        return f"{self.how}{error}{'; ' if self.known else ''}{self.known} ({self.at})"


class Notebook(Config):
    """Everything that is known of one rig. It is kept in one file, which `save` replaces as a whole."""

    schema_version: Literal[1] = 1
    values: dict[str, Taught] = Field(default_factory=dict[str, Taught])
    """By the path of the field in `rig.toml`; `aside.` marks values that are not in it."""
    touches: dict[str, Pose] = Field(default_factory=dict[str, Pose])
    """The flange in the base frame while the tip was at a thing, by its name: `pin 0`, `board-corner lower left 1`."""
    done: dict[StepName, str] = Field(default_factory=dict[StepName, str])
    """Steps that were finished, and when."""

    @classmethod
    def load(cls, rig_path: Path) -> Notebook:
        """What was taught of this rig; an empty notebook where there is no file. Raises `ConfigError`."""
        path = notebook_path(rig_path)
        try:
            return cls.model_validate_json(read_text(path, MAX_BYTES)) if path.exists() else cls()
        except ValidationError as error:
            raise refusal(path, error, cls) from None

    def save(self, rig_path: Path) -> None:
        """Replace the file; returns once it is safe against a loss of power. Raises `ConfigError`."""
        path = notebook_path(rig_path)
        try:
            with replacing(path) as part, part.open("w", encoding="utf-8") as file:
                file.write(self.model_dump_json(indent=1))
                sync(file)
            fsync_folder(path.absolute().parent)
        except OSError as error:
            raise ConfigError(path, "", error.strerror or str(error)) from None

    @property
    def framing(self) -> Framing:
        """Framing that the controller answered; `sof` until that is known."""
        return "bare" if self.get("robot.framing") == "bare" else "sof"

    def get(self, field: str) -> Value | None:
        """The value of a field; None where it was not taught."""
        known = self.values.get(field)
        return None if known is None else known.value

    def number(self, field: str) -> float:
        """A value that is one number. Raises KeyError where it was not taught."""
        value = self.values[field].value
        assert isinstance(value, int | float)
        return float(value)

    def numbers(self, field: str) -> tuple[float, ...]:
        """A value that is a list of numbers. Raises KeyError where it was not taught."""
        value = self.values[field].value
        assert isinstance(value, list)
        return tuple(float(v) for v in value if not isinstance(v, list))

    def table(self, beginning: str) -> dict[str, Value]:
        """The values whose paths begin like this, by the rest of their paths."""
        return {name.removeprefix(beginning): t.value for name, t in self.values.items() if name.startswith(beginning)}

    def touched(self, kind: str) -> dict[str, Pose]:
        """Everything touched of one kind, by the rest of its name, in the order in which it was touched."""
        return {name[len(kind) + 1 :]: pose for name, pose in self.touches.items() if name.split(" ")[0] == kind}

    def with_values(self, values: Mapping[str, Taught]) -> Notebook:
        """The same with these values; others stay."""
        return self.model_copy(update={"values": {**self.values, **values}})

    def with_touch(self, name: str, flange: Pose) -> Notebook:
        """The same with one more touch, or another one in its place."""
        return self.model_copy(update={"touches": {**self.touches, name: flange}})

    def without(self, *names: str) -> Notebook:
        """The same without the values whose paths begin like this, and without what was touched of these kinds, such
        as `pin`, or of these names, such as `pin 0`."""
        values = {field: known for field, known in self.values.items() if not field.startswith(names)}
        touches = {n: touch for n, touch in self.touches.items() if n not in names and n.split(" ")[0] not in names}
        return self.model_copy(update={"values": values, "touches": touches})

    def finished(self, step: StepName) -> Notebook:
        """The same with this step done. Only the proof proves what it rests on: after another step it is done again."""
        unproven = self.reopened("proof")
        return unproven.model_copy(update={"done": {**unproven.done, step: now_utc()}})

    def reopened(self, step: StepName) -> Notebook:
        """The same with this step to be done again."""
        return self.model_copy(update={"done": {name: at for name, at in self.done.items() if name != step}})


def notebook_path(rig_path: Path) -> Path:
    """Where the notebook of a rig lies: beside its `rig.toml`."""
    return rig_path.with_name(rig_path.stem + ENDING)


def gaps(notebook: Notebook) -> Iterator[Check]:
    """Steps that were not finished, and values that were taken over from a pendant or a default: for `rig check`."""
    if not notebook.values:
        return
    for step in STEPS:
        if step not in notebook.done:
            arm = " --arm" if step == "proof" else ""
            yield unmeasured(f"step {step}", "not done since something was taught", f"brushloop rig teach {step}{arm}")
    for path, known in notebook.values.items():
        if known.known.startswith(UNKNOWN) and not path.startswith(ASIDE):
            yield unmeasured(path, f"{known.value} {known.unit}".rstrip(), f"{known.how}, {known.known}")


def rig_of(notebook: Notebook, rig_path: Path) -> RigConfig:
    """The configuration that the notebook gives, without overrides from the environment. Raises `ConfigError`."""
    try:
        rig = RigConfig.model_validate(tomllib.loads(rig_text(notebook, rig_path)))
    except ValidationError as error:
        raise refusal(rig_path, error, RigConfig) from None
    return rig.model_copy(update={"camera": with_optics(rig_path, rig.camera)})


def rig_text(notebook: Notebook, rig_path: Path) -> str:
    """`rig.toml`: every value with how it was obtained, how well it is known, and when."""
    proven = notebook.done.get("proof")
    lines = [HEAD, UNPROVEN if proven is None else f"{PROVEN}, {proven}.", *UNTRIED.splitlines()]
    tables = defaultdict[str, list[str]](list)
    named = {"name": rig_path.stem, "paper.name": "Xuan paper"}
    for path, value in {**named, **notebook.table("")}.items():
        if path.startswith(ASIDE):
            continue
        table, _, name = path.rpartition(".")
        if (known := notebook.values.get(path)) is not None:
            tables[table] += [f"# {line}" for line in textwrap.wrap(known.comment().replace("\n", " "), 116)]
        # TOML writes numbers, strings, lists and booleans as JSON does, but for one character.
        text = json.dumps(_rounded(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        tables[table].append(f"{name} = {text}")
    for table in sorted(tables, key=lambda name: (name != "", name.split(".")[0] != "robot", name)):
        lines += ["", *([f"[{table}]"] if table else []), *tables[table]]
    return "\n".join(lines) + "\n"


def write_rig(rig_path: Path, notebook: Notebook) -> Path | None:
    """Write `rig.toml`; returns where an older file with another text is kept. Raises `ConfigError`, OSError."""
    rig_of(notebook, rig_path)
    text = rig_text(notebook, rig_path)
    changed = rig_path.exists() and rig_path.read_text(encoding="utf-8") != text
    kept = set_aside(rig_path, "bak") if changed else None
    write_whole(rig_path, text)
    return kept


def _rounded(value: Value) -> Any:
    """Round a value for the file: no value is known better than 0.001 mm or 0.0001 deg."""
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return round(value, 4) + 0.0 if isinstance(value, float) else value
