"""The first day as a whole: one step after the other, each kept as it is taught, and a `rig.toml` at the end.

Where the arm is and what the camera sees meanwhile is for display only: no step depends on it.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from pathlib import Path

from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.errors import CannotTeach, CollectAborted, ConfigError, StepError
from brushloop.collect.operator import Choice
from brushloop.collect.rig.optics import gray
from brushloop.collect.teach.arm import ArmStep, taught_arm, tip_of
from brushloop.collect.teach.brush import BrushStep, ForceStep
from brushloop.collect.teach.camera import CameraStep, taught_camera
from brushloop.collect.teach.day import Day, Step
from brushloop.collect.teach.guide import LeftOff, Picture, Question, StepState, WentBack
from brushloop.collect.teach.places import LimitsStep, PlacesStep
from brushloop.collect.teach.proof import ProofStep
from brushloop.collect.teach.sheet import SheetStep
from brushloop.collect.teach.store import Notebook, Value, write_rig
from brushloop.collect.teach.tip import TipStep
from brushloop.drivers.devices import Pose, Stamp
from brushloop.drivers.errors import DeviceError

STEPS = (
    ArmStep(),
    CameraStep(),
    TipStep(),
    SheetStep(),
    PlacesStep(),
    BrushStep(),
    ForceStep(),
    LimitsStep(),
    ProofStep(),
)
AGAIN, LEAVE = Choice("a", "try this step again, where it was"), Choice("q", "stop here; what was taught is kept")
AFRESH, EARLIER = Choice("f", "teach this step from its beginning"), Choice("b", "teach the step before it again")
STOPPED = "stopped; the same command resumes from there"
POSE_S, AGAIN_S = 0.3, 3.0
"""Time between two poses, and after which a device that did not answer is asked again."""
See = Callable[[Pose | None, bool], None]
"""Called with the tip, or with the flange and False before the tip is taught; None while the arm does not answer."""
Refused = CannotTeach | DeviceError | CalibrationError | StepError | ConfigError


class Wizard:
    """Leads a person through the steps."""

    def __init__(self, day: Day, steps: Sequence[Step] = STEPS) -> None:
        self._day = day
        self._steps = tuple(steps)

    async def run(self) -> Path:
        """Teach every step that is not done, then write `rig.toml`; returns its path.

        It is written before the proof too, and says then that it is not proven. Raises `CollectAborted` where the
        person stops: the same command resumes from there.
        """
        while (
            step := next((step for step in self._steps if step.name not in self._day.notebook.done), None)
        ) is not None:
            if step.name == "proof":
                await self._written()
            number = self._steps.index(step)
            await self._attempt(step, self._steps[number - 1] if number else None)
        await self._overview(None)
        return await self._written()

    async def again(self, name: str) -> Path | None:
        """Teach one step again; returns the path of `rig.toml` if it could be written.

        Raises `ConfigError` for an unknown name, otherwise as `run` does.
        """
        step = next((step for step in self._steps if step.name == name), None)
        if step is None:
            raise ConfigError("STEP", "", f"{name!r} is not one of {', '.join(step.name for step in self._steps)}")
        missing = [need for need in step.needs if need not in self._day.notebook.done]
        if missing:
            raise CollectAborted(
                f"`{name}` depends on {', '.join(missing)}, which is not taught yet: `brushloop rig new` resumes there"
            )
        self._forget(step)
        while step.name not in self._day.notebook.done:
            await self._attempt(step, None)
        open_steps = [step.name for step in self._steps if step.name not in self._day.notebook.done]
        return await self._written() if open_steps in ([], ["proof"]) else None

    def _forget(self, step: Step) -> None:
        """Forget what a step observed; going back undoes that."""
        self._day.mark()
        self._day.save(self._day.notebook.without(*step.observes).reopened(step.name))

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
        choices = (AGAIN, AFRESH, *((EARLIER,) if earlier is not None else ()), LEAVE)
        question = Question("choose", "How do you want to go on?", choices, AGAIN.key)
        try:
            answer = await self._day.guide.ask(question)
        except LeftOff:
            answer = LEAVE.key
        except WentBack:
            self._day.back()
            return
        if answer == LEAVE.key:
            raise CollectAborted(STOPPED)
        if answer != AGAIN.key:
            self._forget(earlier if answer == EARLIER.key and earlier is not None else step)

    async def _derive(self, step: Step, before: Notebook) -> None:
        """Finish a step: compute again what depends on it, list what changed, and void an earlier proof."""
        notebook, resting = self._day.notebook, {step.name}
        for other in self._steps:
            if resting & set(other.needs):
                resting.add(other.name)
            if other.name == step.name or (other.name in resting and other.name in notebook.done):
                notebook = notebook.with_values(other.derived(notebook))
        self._day.save(notebook.finished(step.name))
        changed = [
            f"{field}: {_shown(old.value)} -> {_shown(new.value)}"
            for field, new in notebook.values.items()
            if new.step != step.name
            and (old := before.values.get(field)) is not None
            and _shown(old.value) != _shown(new.value)
        ]
        if changed:
            await self._day.say("Changed with it, because it depends on this step:", *changed)
        await self._day.say(f"{step.title}: {step.summary(notebook)}")

    async def _written(self) -> Path:
        path, kept = write_rig(self._day.rig_path, self._day.notebook)
        before = "" if kept is None else f"; as it was before: {kept}"
        await self._day.say(f"{path}: written, with how each value was obtained{before}")
        return path

    async def _overview(self, current: str | None) -> None:
        notebook, lines = self._day.notebook, list[StepState]()
        for step in self._steps:
            taught = step.name in notebook.done
            state = "current" if step.name == current else "taught" if taught else "open"
            summary = step.summary(notebook) if taught else ""
            lines.append(StepState(step.name, step.title, step.minutes, state, summary))
        await self._day.guide.overview(tuple(lines))


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


def _shown(value: Value) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_shown(v) for v in value)}]"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


@contextlib.asynccontextmanager
async def watched(
    day: Day, see_pose: See, see_picture: Callable[[Picture | None], None], wanted: Callable[[], bool]
) -> AsyncGenerator[None]:
    """Watch until the block ends. A picture is taken only while one is `wanted`, and only from a stream.

    A device on a cable has one reader at a time, and that is the step.
    """

    async def poses() -> None:
        if "robot.framing" not in day.notebook.values:
            return
        try:
            async with taught_arm(day.notebook) as reader:
                while True:
                    pose = await reader.flange_now()
                    known = "robot.tcp_offset_mm" in day.notebook.values
                    if known:
                        tip_mm = tip_of(pose, day.notebook.numbers("robot.tcp_offset_mm"))
                        pose = Pose(*tip_mm, *pose.quaternion)
                    see_pose(pose, known)
                    await asyncio.sleep(POSE_S)
        finally:
            see_pose(None, False)

    async def pictures() -> None:
        while not (wanted() and "://" in str(day.notebook.get("camera.source") or "")):
            await asyncio.sleep(POSE_S)
        try:
            async with taught_camera(day.notebook, day.clock) as camera:
                after = Stamp(0)
                while wanted():
                    frame = await camera.fresh(after)
                    after = Stamp(frame.exposed_after_ns + 1)
                    see_picture(gray(frame.image))
                    await asyncio.sleep(POSE_S)
        finally:
            see_picture(None)

    tasks = [asyncio.create_task(_again_and_again(look), name=look.__name__) for look in (poses, pictures)]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _again_and_again(look: Callable[[], Awaitable[None]]) -> None:
    while True:
        with contextlib.suppress(DeviceError):
            await look()
        await asyncio.sleep(AGAIN_S)
