"""What has been taught so far, in one file beside the future `rig.toml`, and the visit in which a person teaches it.

The file is written whole after each value. It holds what was observed (where the flange stood at each thing) and what
was found from it, so that a session that was interrupted asks nothing again, and a value that depends on others is
computed again when they change.
"""

from __future__ import annotations

import contextlib
import json
import textwrap
import time
import tomllib
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import pydantic.dataclasses
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from brushloop.collect.errors import ConfigError, NotAccepted, StepError
from brushloop.collect.operator import Asker, Choice, Prompt
from brushloop.collect.rig.check import Check, unmeasured
from brushloop.collect.rig.config import RigConfig, rig_from
from brushloop.collect.rig.config_file import Config, read_text, refusal
from brushloop.drivers.devices import Pose
from brushloop.drivers.host import Clock
from brushloop.drivers.limits import Finite
from brushloop.sessions.disk import fsync_folder, number, replacing, sync

MAX_BYTES = 1024 * 1024
ENDING, ASIDE = ".taught.json", "aside."
Value = bool | int | float | str | list[Finite] | list[list[Finite]]
"""What a field of `rig.toml` can hold."""
StepName = Literal["arm", "camera", "tip", "sheet", "places", "brush", "force", "limits", "proof"]
"""In the order in which they are taught; each may depend on all before it, as the box of the limits on the brush."""
STEPS: tuple[StepName, ...] = get_args(StepName)
UNKNOWN = "not "
"""Beginning of the text for a value that was taken over without a measurement."""
HEAD = "# Made by `brushloop rig new`. Above each value: how it was obtained, how well it is known, when."
UNPROVEN = "# NOT PROVEN: `brushloop rig teach proof --arm` has not been run since the last value was taught."
PROVEN = "# Proven by a dry run, a touch, the self-check and a judged press"
UNTRIED = "# This software has not driven a real cabinet yet: docs/unconfirmed.md lists what may differ."


def now_utc() -> str:
    """The current time in UTC as text, to the second, as the notebook keeps it."""
    return datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


@pydantic.dataclasses.dataclass(frozen=True)
class Taught:
    """The value of one field of `rig.toml`, how it was obtained, and how well it is known."""

    value: Value
    how: str
    """How it was obtained, as a clause."""
    sigma: float | None = None
    """One standard error, in the unit of the field; None where none can be given."""
    known: str = ""
    """How well it is known, in words."""
    at: str = field(default_factory=now_utc)
    """When, in UTC."""

    def comment(self, path: str) -> str:
        """One line for `rig.toml` about the field at `path`, whose end is its unit."""
        error = "" if self.sigma is None else f", standard error {self.sigma:.3g} {path.rpartition('_')[2]}"
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

    def get(self, field: str) -> Any:
        """The value of a field; None where it was not taught."""
        known = self.values.get(field)
        return None if known is None else known.value

    def table(self, beginning: str) -> dict[str, Any]:
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
            yield unmeasured(f"step {step}", "not done since the last change", f"brushloop rig teach {step}{arm}")
    for path, known in notebook.values.items():
        if known.known.startswith(UNKNOWN) and not path.startswith(ASIDE):
            yield unmeasured(path, f"{known.value} {path.rpartition('_')[2]}", f"{known.how}, {known.known}")


def rig_of(notebook: Notebook, rig_path: Path) -> RigConfig:
    """The configuration that the notebook gives, without overrides from the environment. Raises `ConfigError`."""
    return rig_from(rig_path, tomllib.loads(rig_text(notebook, rig_path)))


def rig_text(notebook: Notebook, rig_path: Path) -> str:
    """`rig.toml`: every value with how it was obtained, how well it is known, and when."""
    proven = notebook.done.get("proof")
    lines = [HEAD, UNPROVEN if proven is None else f"{PROVEN}, {proven}.", UNTRIED]
    tables = defaultdict[str, list[str]](list)
    named = {"name": rig_path.stem, "paper.name": "Xuan paper"}
    for path, value in {**named, **notebook.table("")}.items():
        if path.startswith(ASIDE):
            continue
        table, _, name = path.rpartition(".")
        if (known := notebook.values.get(path)) is not None:
            comment = known.comment(path).replace("\n", " ")
            tables[table] += [f"# {line}" for line in textwrap.wrap(comment, 116)]
        tables[table].append(f"{name} = {toml_value(value)}")
    for table in sorted(tables, key=lambda name: (name != "", name.split(".")[0] != "robot", name)):
        lines += ["", *([f"[{table}]"] if table else []), *tables[table]]
    return "\n".join(lines) + "\n"


def toml_value(value: Value) -> str:
    """A value as `rig.toml` has it, rounded: none is known better than 0.001 mm or 0.0001 deg."""
    match value:
        case list():
            return f"[{', '.join(map(toml_value, value))}]"
        case float():
            return str(round(value, 4) + 0.0)
        case _:
            # TOML writes texts, whole numbers and truth as JSON does, but for one character.
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


Picture = NDArray[np.uint8]
"""(h, w) gray."""
ARM = Choice("a", "let the arm move: I look at the robot cell, my hand is at the emergency stop")
STAY = Choice("x", "leave the arm where it is")
YES, NO = Choice("y", "yes"), Choice("n", "no")
THERE, SKIP = Choice("enter", "done"), Choice("k", "skip this")
Tone = Literal["finding", "warning", "trouble"]
"""After a warning the step can go on; trouble ends it, and its last line says what to do."""


class LeftOff(Exception):
    """The person ended the session in the middle; everything taught so far is kept."""


class WentBack(Exception):
    """The person wants to go back one question: what was answered before this one is taken back, and asked again."""


def choice_of(question: str, choices: tuple[Choice, ...], default: str = "") -> Prompt:
    """A question with answers on keys; Enter stands for the default, or for nothing if there is none."""
    return Prompt(question, choices, default, answers={"enter": default} if default else {})


def number_of(
    question: str, low: float, high: float, unit: str, default: str = "", check: Callable[[float], Check] | None = None
) -> Prompt:
    """A question for a number of this range; `check` compares it with what is known already."""

    def read(line: str) -> float:
        try:
            value = number(line.replace(",", "."))
        except ValueError:
            raise ValueError(f"{line!r} is not a number") from None
        if not low <= value <= high:
            raise ValueError(f"{value:g} is outside {low:g} to {high:g} {unit}")
        if check is not None and (checked := check(value)).verdict == "contradicts":
            raise ValueError(f"{value:g} {unit} is not plausible ({checked.allowed}). {checked.remedy}")
        return value

    return Prompt(question, default=default, read=read, allowed=f"{low:g} to {high:g} {unit}")


class Visit:
    """One session with a person at one rig. What is kept is on disk at once; a screen in another thread reads it."""

    def __init__(self, rig_path: Path, clock: Clock, *, armed: bool) -> None:
        """`armed`: the command line allows motion; the person is asked again each time. Raises `ConfigError`."""
        self.rig_path = rig_path
        self.clock = clock
        self.armed = armed
        self.asker = Asker(watched=True)
        self.notebook = Notebook.load(rig_path)
        self.step = ""
        """Which step is taught now."""
        self.findings: list[tuple[Tone, str]] = []
        self.picture: Picture | None = None
        """The newest picture of a finding."""
        self.live: Picture | None = None
        """What the camera sees now, while somebody guides something by it."""
        self.doing: tuple[str, float] = ("", time.monotonic())
        """What is at work while nothing is asked, empty where no step has said so, and since when."""
        self._answered: list[Notebook] = []
        """The notebook as it was at each question of this process that was answered."""

    # The notebook

    def save(self, notebook: Notebook) -> None:
        """Replace the notebook."""
        notebook.save(self.rig_path)
        self.notebook = notebook

    def keep(self, values: Mapping[str, Taught]) -> None:
        """Note values by their fields: after a loss of power all of them are known, or none."""
        self.save(self.notebook.with_values(values))

    def forget(self, *names: str) -> None:
        """Take values and touches out of the notebook, so that they are asked for again."""
        self.save(self.notebook.without(*names))

    @contextlib.contextmanager
    def asked_again_if_refused(self, *names: str) -> Generator[None]:
        """Forget values and touches of these names where they contradict each other; they are asked for again."""
        try:
            yield
        except (NotAccepted, StepError):
            self.forget(*names)
            raise

    def teach_afresh(self, step: Step) -> None:
        """Forget what a step observed; going back undoes that."""
        self._answered.append(self.notebook)
        self.save(self.notebook.without(*step.observes).reopened(step.name))

    def back(self) -> None:
        """Restore the notebook of the last answered question, if there is one, so that it is asked again."""
        if self._answered:
            self.save(self._answered.pop())

    # The person

    def say(self, *lines: str, tone: Tone = "finding", picture: Picture | None = None) -> None:
        """Show lines, and a picture if there is one."""
        self.findings.append((tone, "\n".join(lines)))
        self.picture = self.picture if picture is None else picture

    def working(self, what: str) -> None:
        """Show what is being done until the next question."""
        self.doing = what, time.monotonic()

    async def ask(self, prompt: Prompt, *, back: bool = True) -> Any:
        """Wait for an answer that the prompt allows, and let going `back` lead here. Raises `WentBack` and `LeftOff`.

        A step asks nothing that is in the notebook, so the notebook of now leads it to this question again; answers
        that were not kept are one with those before them.
        """
        notebook = self.notebook
        try:
            answer = await self.asker.ask(prompt)
        finally:
            self.working("")
        if back and not (self._answered and self._answered[-1] is notebook):
            self._answered.append(notebook)
        return answer

    async def yes(self, question: str) -> bool:
        """Ask for yes or no; Enter is neither."""
        return await self.ask(choice_of(question, (YES, NO))) == YES.key

    async def brought(self, thing: str, how: str, *, may_skip: bool = False) -> bool:
        """Ask the person to bring a thing somewhere; False if it is skipped, where it `may_skip`."""
        choices = (THERE, SKIP) if may_skip else (THERE,)
        answers = {choice.key: choice is THERE for choice in choices}
        return bool(await self.ask(Prompt(how, choices, thing=thing, answers=answers)))

    async def value(self, field: str, prompt: Prompt, sigma: float | None = None) -> Any:
        """The value of a field, which is asked for and kept if it is not known yet."""
        if field not in self.notebook.values:
            value = await self.ask(prompt)
            agreed = isinstance(value, float) and prompt.default and value == float(prompt.default)
            how = "suggested, and accepted" if agreed else f"typed: {prompt.question}"
            self.keep({field: Taught(value, how, sigma)})
        return self.notebook.get(field)

    async def may_move(self, what: str) -> None:
        """Ask for the key that lets the arm move. Raises `NotAccepted` unless both it and `--arm` are given."""
        if not self.armed:
            raise NotAccepted(f"{what}: this moves the arm.", "Start the same command again with --arm.")
        question = f"{what}. The arm moves by itself, slower than 50 mm/s. Is everybody out of its reach?"
        if await self.ask(choice_of(question, (ARM, STAY), STAY.key)) != ARM.key:
            raise NotAccepted("the arm was left where it is.", "Try this step again once the arm may move.")


class Step(ABC):
    """One step of the first day, which may use whatever the steps before it taught."""

    name: ClassVar[StepName]
    title: ClassVar[str]
    minutes: ClassVar[int]
    observes: ClassVar[tuple[str, ...]] = ()
    """Beginnings of fields and kinds of touches that are forgotten when it is taught again."""

    @abstractmethod
    async def carry_out(self, visit: Visit) -> None:
        """Ask, measure and keep. Raises `WentBack`, `LeftOff`, `NotAccepted` and what the devices raise."""

    def derived(self, notebook: Notebook) -> dict[str, Taught]:
        """Values that follow from the notebook alone; computed again once a step before this one was taught again."""
        return {}
