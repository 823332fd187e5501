"""The first day as a whole: one step after the other, each kept as it is taught, and a `rig.toml` at the end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from brushloop.calibrate.files import write_whole
from brushloop.collect.commission.arm import ArmStep
from brushloop.collect.commission.brush import BrushStep, ForceStep
from brushloop.collect.commission.camera import CameraStep
from brushloop.collect.commission.places import LimitsStep, PlacesStep
from brushloop.collect.commission.proof import ProofStep
from brushloop.collect.commission.sheet import SheetStep
from brushloop.collect.commission.tip import TipStep
from brushloop.collect.commission.visit import LeftOff, Step, Visit, WentBack, choice_of, rig_of, rig_text, toml_value
from brushloop.collect.errors import CollectAborted, ConfigError, NotAccepted, StepError, describe
from brushloop.collect.operator import Choice
from brushloop.drivers.errors import DeviceError
from brushloop.sessions.disk import set_aside
from brushloop.sessions.errors import InputError

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
AGAIN = Choice("a", "try again: all values so far are kept")
REFUSED = (NotAccepted, DeviceError, InputError, StepError, ConfigError)


class Wizard:
    """Leads a person through the steps."""

    def __init__(self, visit: Visit, steps: Sequence[Step] = STEPS) -> None:
        self._visit = visit
        self._steps = {str(step.name): step for step in steps}

    async def run(self) -> Path:
        """Teach every step that is not done, then write `rig.toml`; returns its path.

        Raises `CollectAborted` where the person stops: the same command resumes from there.
        """
        while names := self._open():
            await self._attempt(self._steps[names[0]])
        return self._written()

    async def again(self, name: str) -> Path | None:
        """Teach one step again; returns the path of `rig.toml` if it could be written.

        Raises `ConfigError` for an unknown name, otherwise as `run` does.
        """
        if name not in self._steps:
            raise ConfigError("STEP", "", f"{name!r} is not one of {', '.join(self._steps)}")
        names = list(self._steps)
        if missing := [open_name for open_name in self._open() if names.index(open_name) < names.index(name)]:
            raise CollectAborted(
                f"`{name}` depends on {', '.join(missing)}, which is not taught yet: `brushloop rig new` resumes there"
            )
        self._visit.teach_afresh(self._steps[name])
        while name in self._open():
            await self._attempt(self._steps[name])
        return self._written() if self._open() in ([], ["proof"]) else None

    def _open(self) -> list[str]:
        """Steps that are not done."""
        return [name for name in self._steps if name not in self._visit.notebook.done]

    async def _attempt(self, step: Step) -> None:
        """Teach a step once. Where the person goes back, or where it fails, the notebook says what comes next.

        Raises `CollectAborted` where the person stops.
        """
        visit, number = self._visit, list(self._steps).index(step.name) + 1
        visit.step = f"step {number} of {len(self._steps)}: {step.title}, about {step.minutes} min"
        if step.name == "proof":
            self._written()
        try:
            try:
                await step.carry_out(visit)
                self._derive(step)
            except REFUSED as error:
                unhelpful = isinstance(error, DeviceError) and not error.remedy
                visit.say(describe(error), *(["Check power, cable and address."] if unhelpful else []), tone="trouble")
                await visit.ask(choice_of("How do you want to go on?", (AGAIN,), AGAIN.key), back=False)
        except LeftOff:
            raise CollectAborted("stopped; run the same command again to resume") from None
        except WentBack:
            visit.back()

    def _derive(self, step: Step) -> None:
        """Finish a step: compute again what later ones made of it, list what changed, and void an earlier proof."""
        before = self._visit.notebook
        notebook, changed, steps = before.with_values(step.derived(before)), list[str](), list(self._steps.values())
        for later in steps[steps.index(step) + 1 :]:
            if later.name in notebook.done:
                values = later.derived(notebook)
                notebook = notebook.with_values(values)
                changed += [
                    f"{field}: {toml_value(old)} -> {toml_value(new.value)}"
                    for field, new in values.items()
                    if (old := before.get(field)) is not None and toml_value(old) != toml_value(new.value)
                ]
        self._visit.save(notebook.finished(step.name))
        self._visit.picture = None  # the next step is about something else
        if changed:
            self._visit.say("These values depend on this step and changed with it:", *changed)
        self._visit.say(f"✓ {step.title}: done")

    def _written(self) -> Path:
        """Write `rig.toml`, which says whether it is proven; an older file with another text is kept.

        Raises `ConfigError` for values that cannot be used together, and OSError.
        """
        path, notebook, before = self._visit.rig_path, self._visit.notebook, ""
        rig_of(notebook, path)
        text = rig_text(notebook, path)
        if path.exists() and path.read_text(encoding="utf-8") != text:
            before = f"; the earlier file is kept as {set_aside(path, 'bak')}"
        write_whole(path, text)
        self._visit.say(f"{path} is written; it says how each value was obtained{before}")
        return path
