"""What has been taught so far: one file beside the future `rig.toml`, written whole after each value.

It holds what was observed (where the flange stood at each thing) and what was found from it, so that a session that
was interrupted asks nothing again, and a value that depends on others is computed again when they change.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import Field, ValidationError

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.check import Check, unmeasured
from brushloop.collect.rig.config_file import Config, Finite, read_text, refusal
from brushloop.drivers.arcs.wire import Framing
from brushloop.drivers.devices import Pose
from brushloop.sessions.disk import fsync_folder, sync

MAX_BYTES = 1024 * 1024
ENDING = ".taught.json"

Plain = bool | int | float | str
Value = Plain | list[Finite] | list[list[Finite]]
"""What a field of `rig.toml` can hold."""
FieldName = Annotated[str, Field(min_length=3, max_length=100, pattern=r"^[a-z0-9_]+(\.[a-z0-9_]+)*$")]
ThingName = Annotated[str, Field(max_length=60)]
StepName = Literal["arm", "camera", "tip", "sheet", "places", "brush", "force", "limits", "proof"]
"""In the order in which they are taught: the box of the limits needs the deepest press."""
STEPS: tuple[StepName, ...] = get_args(StepName)
UNKNOWN = "not "
"""Beginning of the text for a value that was taken over without a measurement."""


class Taught(Config):
    """One value: where it goes in `rig.toml`, how it was obtained, and how well it is known."""

    value: Value
    unit: Annotated[str, Field(max_length=20)] = ""
    how: Annotated[str, Field(max_length=400)]
    """How it was obtained, as a clause."""
    sigma: Annotated[float, Field(ge=0.0)] | None = None
    """One standard error, in the unit; None where none can be given."""
    known: Annotated[str, Field(max_length=400)] = ""
    """How well it is known, in words."""
    at: Annotated[str, Field(max_length=40)]
    """When, in UTC."""
    step: StepName

    def comment(self) -> str:
        """One line for `rig.toml`."""
        error = "" if self.sigma is None else f", standard error {self.sigma:.3g} {self.unit}".rstrip()
        return f"{self.how}{error}{'; ' if self.known else ''}{self.known} ({self.at})"


class Touch(Config):
    """Pose of the flange in the base frame while the tip was at a thing, and when."""

    position_mm: tuple[Finite, Finite, Finite]
    quaternion: tuple[Finite, Finite, Finite, Finite]
    at: Annotated[str, Field(max_length=40)]

    def pose(self) -> Pose:
        """The flange."""
        return Pose(*self.position_mm, *self.quaternion)


class Notebook(Config):
    """Everything that is known of one rig."""

    schema_version: Literal[1] = 1
    values: dict[FieldName, Taught] = Field(default_factory=dict[str, Taught], max_length=300)
    """By the path of the field in `rig.toml`; `aside.` marks values that are not in it."""
    touches: dict[ThingName, Touch] = Field(default_factory=dict[str, Touch], max_length=300)
    """By what was touched: `pin 0`, `board-corner lower left 1`."""
    done: dict[StepName, str] = Field(default_factory=dict[StepName, str])
    """Steps that were finished, and when."""

    def with_values(self, values: dict[str, Taught]) -> Notebook:
        """The same with these values; others stay."""
        return self.model_copy(update={"values": {**self.values, **values}})

    def with_touch(self, name: str, touch: Touch) -> Notebook:
        """The same with one more touch, or another one in its place."""
        return self.model_copy(update={"touches": {**self.touches, name: touch}})

    @property
    def framing(self) -> Framing:
        """Framing that the controller answered; `sof` until that is known."""
        return "bare" if self.get("robot.framing") == "bare" else "sof"

    def without(self, *beginnings: str) -> Notebook:
        """The same without the values whose paths begin like this."""
        kept = {field: taught for field, taught in self.values.items() if not field.startswith(beginnings)}
        return self.model_copy(update={"values": kept})

    def without_touches(self, *things: str) -> Notebook:
        """The same without what was touched of these kinds, such as `pin`, or of these names, such as `pin 0`."""
        kept = {n: touch for n, touch in self.touches.items() if n not in things and n.split(" ")[0] not in things}
        return self.model_copy(update={"touches": kept})

    def finished(self, step: StepName, *, reopens: tuple[StepName, ...] = ()) -> Notebook:
        """The same with this step done, and others to be done again."""
        done = {name: at for name, at in self.done.items() if name not in reopens}
        return self.model_copy(update={"done": {**done, step: now_utc()}})

    def reopened(self, step: StepName) -> Notebook:
        """The same with this step to be done again."""
        return self.model_copy(update={"done": {name: at for name, at in self.done.items() if name != step}})

    def get(self, field: str) -> Value | None:
        """The value of a field; None where it was not taught."""
        taught = self.values.get(field)
        return None if taught is None else taught.value

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

    def touched(self, kind: str) -> dict[str, Pose]:
        """Everything touched of one kind, by the rest of its name, in the order in which it was touched."""
        return {name[len(kind) + 1 :]: t.pose() for name, t in self.touches.items() if name.split(" ")[0] == kind}


class TaughtFile:
    """The notebook on disk. `save` returns once it is safe there."""

    def __init__(self, rig_path: Path) -> None:
        self.path = rig_path.with_name(rig_path.stem + ENDING)

    def load(self) -> Notebook:
        """What was taught before; an empty notebook where there is no file. Raises `ConfigError`."""
        if not self.path.exists():
            return Notebook()
        try:
            return Notebook.model_validate_json(read_text(self.path, MAX_BYTES))
        except ValidationError as error:
            raise refusal(self.path, error, Notebook) from None

    def save(self, notebook: Notebook) -> None:
        """Write the whole file beside the old one, wait for the disk, then take its place. Raises `ConfigError`."""
        text = notebook.model_dump_json(indent=1)
        if len(text) > MAX_BYTES:
            raise ConfigError(self.path, "", f"would be larger than {MAX_BYTES} bytes")
        part = self.path.with_name(self.path.name + ".part")
        try:
            with part.open("w", encoding="utf-8") as file:
                file.write(text)
                sync(file)
            part.replace(self.path)
            fsync_folder(self.path.absolute().parent)
        except OSError as error:
            raise ConfigError(self.path, "", error.strerror or str(error)) from None


def now_utc() -> str:
    """The current time in UTC as text, to the second, as the notebook keeps it."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def touch_of(pose: Pose) -> Touch:
    """The pose of the flange as a touch, with the current time."""
    return Touch(position_mm=pose.position_mm, quaternion=pose.quaternion, at=now_utc())


def gaps(notebook: Notebook) -> Iterator[Check]:
    """Steps that were not finished, and values that were taken over from a pendant or a default: for `rig check`."""
    if not notebook.values:
        return
    for step in STEPS:
        if step not in notebook.done:
            arm = " --arm" if step == "proof" else ""
            yield unmeasured(f"step {step}", "not done since something was taught", f"brushloop rig teach {step}{arm}")
    for field, taught in notebook.values.items():
        if taught.known.startswith(UNKNOWN) and not field.startswith("aside."):
            yield unmeasured(field, f"{taught.value} {taught.unit}".rstrip(), f"{taught.how}, {taught.known}")
