"""The set-up wizard: what each step measured, whether it is good enough, and the engine's question about it."""

from __future__ import annotations

from textual import events
from textual.content import Content

from brushloop.collect.engine.snapshot import Fact, SetUpStep, Snapshot, Standing
from brushloop.collect.headless import RunnableEngine, no_pose_text
from brushloop.collect.operator import Prompt
from brushloop.collect.protocols.steps import StepKind
from brushloop.collect.tui.force_text import LEAST_SCALE_N, force_bar, spark
from brushloop.collect.tui.keys import SET_UP_BAR, keys_in
from brushloop.collect.tui.panes import target_text
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.question_screens import answer_by_key, choices_content
from brushloop.collect.tui.steps_screen import StepsScreen
from brushloop.collect.tui.text import SOFTWARE_STOP, one_line, plain, tip_text

SIGNS = {
    Standing.TO_COME: ("·", "dim"),
    Standing.NOW: ("▶", "bold reverse"),
    Standing.GOOD: ("✓", "bold $text-success"),
    Standing.DOUBTFUL: ("!", "bold $text-warning"),
}
SHARP_PX = 2.0
"""Blur in the full frame below which the lens is in focus: a hint for turning it; the step's own check decides."""
BAR_COLUMNS = 30


class SetUpScreen(StepsScreen):
    """One screen for all steps: the list, what was measured, the live figures, the question."""

    DEFAULT_CSS = """
    SetUpScreen #title.-silent { background: $error; color: $text; }
    """

    def __init__(self, engine: RunnableEngine, pictures: Pictures) -> None:
        super().__init__(pictures.make("picture") if pictures.camera_shown else None, SET_UP_BAR)
        self._engine = engine
        self._prompt: Prompt | None = None

    def show(self, now: Snapshot) -> None:
        """Draw what differs."""
        session = one_line(now.session_id) or "no session yet"
        doing = ", ".join(part for part in (f"{now.state}: {one_line(now.step)}", no_pose_text(now)) if part)
        self._title.show(f"Set-up   {session}   {doing}")
        self._title.set_class(now.no_pose_s is not None, "-silent")
        self._steps.show(_steps_content(now.set_up))
        self._found.show(_found_content(now.set_up))
        self._live.show(_live_content(now))
        if now.picture is not None and self._picture is not None and self._picture.display:
            self._picture.show(now.picture.image)
        self._prompt = now.prompt
        self.set_class(now.prompt is not None, "-asking")
        if now.prompt is not None:
            question = Content.styled(plain(now.prompt.question), "bold")
            self._asked.show(Content("\n").join((question, choices_content(now.prompt))))
        self._note.show(SOFTWARE_STOP)
        self._keys.show(keys_in(now.state, SET_UP_BAR))

    def on_key(self, event: events.Key) -> None:
        """Answer, if it is the key of an answer."""
        if self._prompt is not None:
            answer_by_key(self._prompt, self._engine, event)


def _steps_content(steps: tuple[SetUpStep, ...]) -> Content:
    """One line a step: `✓ Camera, board, scale`."""
    lines = [
        Content.assemble(SIGNS[step.standing], f" {step.title}\n", (f"  {step.standing}", "dim")) for step in steps
    ]
    return Content("\n").join(lines)


def _found_content(steps: tuple[SetUpStep, ...]) -> Content:
    """What was measured, newest step first: the question is about that one."""
    parts: list[Content] = []
    for step in reversed(steps):
        if step.facts:
            parts.append(Content.styled(step.title, "bold underline"))
            parts += [_fact(fact) for fact in step.facts]
            parts.append(Content(""))
    return Content("\n").join(parts) if parts else Content.styled("nothing measured yet", "dim")


def _live_content(now: Snapshot) -> Content:
    """Tip, target, force, and focus at this moment."""
    blur = "no picture yet"
    if now.picture is not None:
        blur_px = now.picture.blur_px
        if blur_px is None:
            blur = "no edge in view to measure"
        else:
            blur = f"blur {blur_px:.1f} px  {'✓ sharp' if blur_px < SHARP_PX else '! turn the lens'}"
    force = f"{force_bar(now.force_n, LEAST_SCALE_N, BAR_COLUMNS)} {spark(now.trace_n, 20)}"
    if now.force_n is not None and not _zeroed(now.set_up):
        force = f"{now.force_n:.3f} N with the weight of the holder; zero touch sets it to zero"
    tip = no_pose_text(now) or tip_text(now.tip_mm)
    rows = (("Tip", tip), ("Target", target_text(now)), ("Force", force), ("Focus", blur))
    return Content("\n").join(Content.assemble((name.ljust(8), "dim"), text) for name, text in rows)


def _zeroed(steps: tuple[SetUpStep, ...]) -> bool:
    return any(step.kind is StepKind.ZERO_TOUCH and step.standing is not Standing.TO_COME for step in steps)


def _fact(fact: Fact) -> Content:
    sign, style = {True: ("✓", "$text-success"), False: ("!", "bold $text-warning"), None: (" ", "")}[fact.good]
    limit = f"  ({fact.limit})" if fact.limit else ""
    return Content.assemble((sign, style), f" {fact.name.ljust(20)} {fact.value}", (limit, "dim"))
