"""The first day as a whole: one step after the other, each kept as it is taught, and a `rig.toml` at the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import CannotTeach, CollectAborted, ConfigError, StepError
from brushloop.collect.operator import Choice
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.guide import LeftOff, StepState, WentBack
from brushloop.collect.teach.rig_text import write_rig
from brushloop.collect.teach.steps import all_steps
from brushloop.collect.teach.store import Notebook, StepName, Value
from brushloop.drivers.errors import DeviceError

AGAIN, LEAVE = Choice("a", "try this step again, where it was"), Choice("q", "stop here; what was taught is kept")
AFRESH, EARLIER = Choice("f", "teach this step from its beginning"), Choice("b", "teach the step before it again")
STOPPED = "stopped; the same command resumes from there"
SAME = 1e-6
Refused = CannotTeach | DeviceError | CalibrationError | StepError | ConfigError


class Wizard:
    """Leads a person through the steps."""

    def __init__(self, day: Day, steps: Sequence[Step] | None = None) -> None:
        self._day = day
        self._steps = tuple(all_steps() if steps is None else steps)

    async def run(self) -> Path:
        """Teach every step that is not done, then write `rig.toml`; returns its path.

        It is written before the proof too, and says then that it is not proven. Raises `CollectAborted` where the
        person stops: the same command resumes from there.
        """
        while (step := self._open()) is not None:
            if step.name == "proof":
                await self._written()
            await self._attempt(step, self._before(step))
        await self._overview(None)
        return await self._written()

    async def again(self, name: str) -> Path | None:
        """Teach one step again; returns the path of `rig.toml` if it could be written.

        Raises `ConfigError` for an unknown name, otherwise as `run` does.
        """
        step = next((one for one in self._steps if one.name == name), None)
        if step is None:
            raise ConfigError("STEP", "", f"{name!r} is not one of {', '.join(one.name for one in self._steps)}")
        missing = [need for need in step.needs if need not in self._day.notebook.done]
        if missing:
            raise CollectAborted(
                f"`{name}` depends on {', '.join(missing)}, which is not taught yet: `brushloop rig new` resumes there"
            )
        self._day.guide.mark()
        self._day.save(step.forget(self._day.notebook).reopened(step.name))
        while step.name not in self._day.notebook.done:
            await self._attempt(step, None)
        rest = [one.name for one in self._steps if one.name not in self._day.notebook.done]
        if rest and rest != ["proof"]:
            return None
        return await self._written()

    def _open(self) -> Step | None:
        """The first step that is not done."""
        return next((step for step in self._steps if step.name not in self._day.notebook.done), None)

    def _before(self, step: Step) -> Step | None:
        """The step before this one."""
        number = self._steps.index(step)
        return self._steps[number - 1] if number else None

    async def _attempt(self, step: Step, earlier: Step | None) -> None:
        """Teach a step once. Where the person goes back, or where it fails, the notebook says what comes next.

        Raises `CollectAborted` where the person stops.
        """
        day = self._day
        await self._overview(step.name)
        before = day.notebook
        try:
            await step.teach(day)
            await self._derive(step, before)
            return
        except LeftOff:
            raise CollectAborted(STOPPED) from None
        except WentBack:
            if day.back():
                return
        except (CannotTeach, DeviceError, CalibrationError, StepError, ConfigError) as error:
            await day.say(*_in_lines(error), tone="trouble")
        await self._ask_how(step, earlier)

    async def _ask_how(self, step: Step, earlier: Step | None) -> None:
        """Ask how to go on with a step that could not be finished."""
        day, choices = self._day, (AGAIN, AFRESH, *((EARLIER,) if earlier is not None else ()), LEAVE)
        try:
            answer = await day.person.choose("How do you want to go on?", choices, AGAIN.key)
        except LeftOff:
            answer = LEAVE.key
        except WentBack:
            day.back()
            return
        if answer == LEAVE.key:
            raise CollectAborted(STOPPED)
        day.guide.settle()
        if answer != AGAIN.key:
            day.guide.mark()
            one = earlier if answer == EARLIER.key and earlier is not None else step
            day.save(one.forget(day.notebook).reopened(one.name))

    async def _derive(self, step: Step, before: Notebook) -> None:
        """Finish a step: compute again what depends on it, list what changed, and void an earlier proof."""
        notebook = self._day.notebook
        dependent = self._resting_on(step.name)
        for one in self._steps:
            if one.name == step.name or (one.name in dependent and one.name in notebook.done):
                notebook = notebook.with_values(one.derived(notebook))
        reopened: tuple[StepName, ...] = ("proof",) if step.name != "proof" else ()
        self._day.save(notebook.finished(step.name, reopens=reopened))
        changed = [
            f"{field}: {_shown(old.value)} -> {_shown(new.value)}"
            for field, new in notebook.values.items()
            if new.step != step.name
            and (old := before.values.get(field)) is not None
            and not _same(old.value, new.value)
        ]
        if changed:
            await self._day.say("Changed with it, because it depends on this step:", *changed)
        await self._day.say(f"{step.title}: {step.summary(notebook)}")

    def _resting_on(self, name: StepName) -> set[StepName]:
        found: set[StepName] = {name}
        for step in self._steps:
            if found & set(step.needs):
                found.add(step.name)
        return found - {name}

    async def _written(self) -> Path:
        path, kept = write_rig(self._day.rig_path, self._day.notebook)
        await self._day.say(
            f"{path}: written, with how each value was obtained"
            + (f"; as it was before: {kept}" if kept is not None else "")
        )
        return path

    async def _overview(self, current: StepName | None) -> None:
        done = self._day.notebook.done
        await self._day.guide.overview(
            tuple(
                StepState(
                    step.name,
                    step.title,
                    step.minutes,
                    "current" if step.name == current else "taught" if step.name in done else "open",
                    step.summary(self._day.notebook) if step.name in done else "",
                )
                for step in self._steps
            )
        )


def _in_lines(error: Refused) -> tuple[str, ...]:
    match error:
        case CannotTeach():
            return error.what, error.way_out
        case DeviceError():
            # With the notes: one of them may say that the arm was not seen at rest.
            state = (f"{error.device}: {error.op}: {error.what}.", error.condition, *getattr(error, "__notes__", []))
            return " ".join(filter(None, state)), error.remedy or "Check power, cable and address."
        case _:
            return (str(error),)


def _same(old: Value, new: Value) -> bool:
    if isinstance(old, list) and isinstance(new, list):
        return len(old) == len(new) and all(_same(a, b) for a, b in zip(old, new, strict=True))
    if isinstance(old, int | float) and isinstance(new, int | float):
        return math.isclose(old, new, abs_tol=SAME)
    return old == new


def _shown(value: Value) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_shown(v) for v in value)}]"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
