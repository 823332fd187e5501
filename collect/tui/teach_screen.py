"""The screen of the first day: steps at the left, findings, a picture, the live pose, and the question."""

from __future__ import annotations

import time
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Input

from brushloop.collect.rig.optics import gray
from brushloop.collect.teach.guide import Brought, JogStep, JogView, Picture, Question, Shown, StepState, number_in
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.teach_guide import ScreenGuide, TeachView
from brushloop.collect.tui.text import SHORT_STOP, one_line, plain, tip_text
from brushloop.collect.tui.widgets import NARROW_COLUMNS, Key, KeyBar, Line

SIGNS = {"open": ("·", "dim"), "current": ("▶", "bold reverse"), "taught": ("✓", "bold $text-success")}
TONES = {"finding": ("", ""), "warning": ("! ", "bold $text-warning"), "trouble": ("✗ ", "bold $text-error")}
HIGH_ROWS = 32
"""Height from which there is room for what was taught, below each step."""
JOG_KEYS = {
    "left": ("x", -1.0),
    "right": ("x", 1.0),
    "down": ("y", -1.0),
    "up": ("y", 1.0),
    "pagedown": ("z", -1.0),
    "pageup": ("z", 1.0),
}
TYPING_STOP = "ctrl-c: software stop; red button: emergency stop"
JOG: Key = ("j", "jog")
SKIP: Key = ("k", "skip")
BASE_KEYS: tuple[Key, ...] = (("q", "leave"), ("tab", "picture"), ("?", "help"))
KEYS: dict[str, tuple[Key, ...]] = {
    "choose": (("s", "STOP"), ("enter", "default"), ("esc", "back"), *BASE_KEYS),
    "number": (("ctrl-c", "STOP"), ("enter", "take"), ("esc", "back"), ("ctrl-q", "leave: all is kept")),
    "text": (("ctrl-c", "STOP"), ("enter", "take"), ("esc", "back"), ("ctrl-q", "leave: all is kept")),
    "bring": (("s", "STOP"), ("enter", "there"), ("esc", "back"), *BASE_KEYS),
    "jog": (
        ("s", "STOP"),
        ("arrows", "x y"),
        ("page up/down", "z"),
        ("1-4", "step"),
        ("enter", "there"),
        ("esc", "back"),
    ),
    "busy": (("s", "STOP"), *BASE_KEYS),
}
LEAVE: tuple[Key, ...] = (("q", "leave"),)
GO_ON: tuple[Key, ...] = (("g", "go on"), *LEAVE)


class TeachScreen(Screen[None]):
    """Shows a `TeachView`; its keys answer the question."""

    DEFAULT_CSS = """
    TeachScreen #title {
        height: 1; padding: 0 1; background: $panel; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
    }
    TeachScreen #body { height: 1fr; }
    TeachScreen #steps {
        width: 27; height: 100%; padding: 0 1; border-right: solid $foreground 40%;
        text-wrap: nowrap; text-overflow: ellipsis;
    }
    TeachScreen #found { width: 1fr; height: 1fr; padding: 0 1; }
    TeachScreen #picture { width: 36%; height: 100%; padding: 0 1; }
    TeachScreen.-narrow #picture { display: none; }
    TeachScreen.-narrow.-picture #picture { display: block; width: 1fr; }
    TeachScreen.-narrow.-picture #found-pane { display: none; }
    TeachScreen #live { height: auto; padding: 0 1; background: $boost; text-wrap: nowrap; }
    TeachScreen #question-box { height: auto; max-height: 13; padding: 0 1; border: heavy $warning; display: none; }
    TeachScreen.-asking #question-box { display: block; }
    TeachScreen #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; }
    TeachScreen #answer { display: none; height: 1; border: none; padding: 0; background: $boost; }
    TeachScreen.-typing #answer { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [Binding("tab", "picture", "Picture", priority=True)]

    def __init__(self, guide: ScreenGuide, name: str, pictures: Pictures) -> None:
        super().__init__()
        self._title, self._steps, self._found = Line("title"), Line("steps"), Line("found-text")
        self._live, self._asked, self._note = Line("live"), Line("question-text"), Line("note")
        self._picture = pictures.make("picture")
        self._keys = KeyBar(KEYS["busy"])
        self._found_pane = VerticalScroll(id="found")
        self._found_pane.can_focus = False
        self._guide = guide
        self._name = name
        self._question: Question | None = None
        self._drawn: TeachView | None = None
        self._step_mm = 0
        """Index of the size of a step by jog."""
        self._input = Input(id="answer", select_on_focus=False)
        self._over = ""
        self._stop_sent = False

    def compose(self) -> ComposeResult:
        """Lay out the parts from top to bottom."""
        yield self._title
        with Horizontal(id="body"):
            yield self._steps
            with Vertical(id="found-pane"), self._found_pane:
                yield self._found
            yield self._picture
        yield self._live
        with VerticalScroll(id="question-box") as box:
            box.can_focus = False
            yield self._asked
            yield self._input
        yield self._note
        yield self._keys

    def on_resize(self, event: events.Resize) -> None:
        """Show the picture beside the findings where there is room."""
        self.set_class(event.size.width < NARROW_COLUMNS, "-narrow")

    def action_picture(self) -> None:
        """Show the picture instead of the findings, on a narrow screen."""
        self.toggle_class("-picture")
        self.call_after_refresh(self._found_pane.scroll_end, animate=False)  # what was hidden could not be scrolled

    @property
    def typing(self) -> bool:
        """Whether letters go into a field."""
        return self._question is not None and self._question.kind in ("number", "text")

    @property
    def asking(self) -> bool:
        """Whether the steps wait for the person: otherwise something is at work."""
        return self._question is not None

    def follow(self, guide: ScreenGuide) -> None:
        """Show another run of the steps."""
        self._guide, self._drawn = guide, None

    def stop_sent(self) -> None:
        """Show at once that a stop key was pressed."""
        self._note.show(Content.styled(" STOP SENT ", "bold reverse"))
        self._stop_sent = True

    def show(self, now: TeachView, over: str = "", keys: tuple[Key, ...] = ()) -> None:
        """Draw what differs. `over` says how it ended, once it has, and `keys` what can be done then."""
        before, self._drawn = self._drawn, now
        self._title.show(f"First day   {one_line(self._name)}{_where(now.steps)}")
        self._steps.show(_steps_content(now.steps, summaries=self.size.height >= HIGH_ROWS))
        self._live.show(_live_text(now))
        self._picture.show(_gray(now.live if self._guide.looking and now.live is not None else now.picture))
        if before is None or before.findings is not now.findings:
            self._found.show(Content("\n").join(_finding(shown) for shown in now.findings))
        if before is None or before.question != now.question or over != self._over:
            self._over = over
            self._ask(now.question, over, keys)
        if before is None or before.findings is not now.findings or before.question is not now.question:
            # Only after the layout is it known where the end is: the question takes its room from the findings.
            self.call_after_refresh(self._found_pane.scroll_end, animate=False)
        if now.question is None and not over and not self._stop_sent:
            self._note.show(_busy_text(now, time.monotonic(), self.size.width - 2))

    def _ask(self, question: Question | None, over: str, keys: tuple[Key, ...]) -> None:
        """Show a question, or that something is at work, or that it is over."""
        self._question, self._stop_sent = question, False
        self.set_class(question is not None or bool(over), "-asking")
        self.set_class(self.typing, "-typing")
        if question is None:
            self.set_focus(None)
            self._asked.show(over)
            self._keys.show(keys if over else KEYS["busy"])
            self._note.show("")
            return
        self._asked.show(_question_content(question, self._step_mm))
        self._note.show(TYPING_STOP if self.typing else SHORT_STOP)
        self._keys.show(_keys_of(question))
        if self.typing:
            self._input.value = ""
            self._input.placeholder = f"Enter: {question.default}" if question.default else ""
            self.set_focus(self._input)
        else:
            self.set_focus(None)

    def on_key(self, event: events.Key) -> None:
        """Answer, if the key is an answer to the question; else page through the findings."""
        question = self._question
        if event.key in ("pageup", "pagedown") and (question is None or question.kind != "jog"):
            event.stop()
            (self._found_pane.scroll_page_up if event.key == "pageup" else self._found_pane.scroll_page_down)()
        elif question is None:
            return
        elif event.key == "escape":
            event.stop()
            self._guide.back(question.number)
        elif question.kind == "choose":
            self._chosen(question, event)
        elif question.kind == "bring":
            self._brought(question, event)
        elif question.kind == "jog" and question.jog is not None:
            self._jogged(question, question.jog, event)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the line, or say why it cannot be taken."""
        question = self._question
        if question is None:
            return
        line = event.value.strip() or question.default
        if question.kind == "text":
            self._guide.answer(question.number, line)
            return
        try:
            self._guide.answer(question.number, number_in(line, question.unit, question.low, question.high))
        except ValueError as error:
            self._note.show(Content.styled(plain(str(error)), "bold $text-warning"))

    def _chosen(self, question: Question, event: events.Key) -> None:
        if event.key == "enter" and question.default:
            self._guide.answer(question.number, question.default)
        elif any(choice.key == event.character for choice in question.choices):
            event.stop()
            self._guide.answer(question.number, str(event.character))

    def _brought(self, question: Question, event: events.Key) -> None:
        answers = {"enter": Brought.DONE}
        answers |= {"j": Brought.JOG} if question.may_jog else {}
        answers |= {"k": Brought.SKIP} if question.may_skip else {}
        if event.key in answers:
            self._guide.answer(question.number, answers[event.key])

    def _jogged(self, question: Question, jog: JogView, event: events.Key) -> None:
        if event.key == "enter":
            self._guide.answer(question.number, Brought.DONE)
        elif event.key in JOG_KEYS:
            event.stop()
            event.prevent_default()
            axis, sign = JOG_KEYS[event.key]
            size_mm = jog.steps_mm[min(self._step_mm, len(jog.steps_mm) - 1)]
            self._guide.answer(question.number, JogStep(axis, sign * size_mm))  # pyright: ignore[reportArgumentType]
        elif event.character is not None and event.character.isdecimal():
            chosen = int(event.character) - 1
            if 0 <= chosen < len(jog.steps_mm):
                self._step_mm = chosen
                self._asked.show(_question_content(question, self._step_mm))


def _gray(picture: Picture | None) -> Picture | None:
    return None if picture is None else gray(picture)


def _where(steps: tuple[StepState, ...]) -> str:
    """Number, title and duration of the current step."""
    for number, step in enumerate(steps, 1):
        if step.state == "current":
            return f"   step {number} of {len(steps)}: {plain(step.title)}, about {step.minutes} min"
    return ""


def _steps_content(steps: tuple[StepState, ...], *, summaries: bool) -> Content:
    """A line for each step, and what was taught below it where there is room."""
    lines: list[Content] = []
    for number, step in enumerate(steps, 1):
        sign, style = SIGNS[step.state]
        lines.append(Content.styled(f"{sign} {number} {plain(step.title)}", style))
        if step.summary and summaries:
            lines.append(Content.styled(f"  {plain(step.summary)}", "dim"))
    return Content("\n").join(lines)


def _finding(shown: Shown) -> Content:
    sign, style = TONES[shown.tone]
    first, *rest = shown.lines
    return Content.styled("\n".join([f"{sign}{plain(first)}", *(plain(line) for line in rest)]), style)


def _keys_of(question: Question) -> tuple[Key, ...]:
    keys = KEYS[question.kind]
    if question.kind == "choose" and not question.default:
        keys = tuple(key for key in keys if key[0] != "enter")
    more = (*((JOG,) if question.may_jog else ()), *((SKIP,) if question.may_skip else ()))
    return (*keys[:2], *more, *keys[2:])


def _busy_text(now: TeachView, now_s: float, columns: int) -> str:
    """What is at work, and for how long: nothing may look as if it hung. How to stop is never cut off."""
    after = f", {max(now_s - now.doing_since_s, 0.0):.0f} s; {SHORT_STOP}"
    what, room = one_line(now.doing or "at work"), max(columns - len(after), 0)
    return (what if len(what) <= room else f"{what[: room - 1]}…") + after


def _live_text(now: TeachView) -> str:
    if now.tip is None:
        return "no pose: the arm is not read now"
    return f"{'tip' if now.tip_known else 'flange'}  {tip_text(now.tip.position_mm)}"


def _question_content(question: Question, step: int) -> Content:
    """The question, and a line for each answer or what is allowed."""
    lines = [Content.styled(plain(question.text), "bold")]
    for choice in question.choices:
        mark = "   (Enter)" if choice.key == question.default else ""
        lines.append(Content.assemble((choice.key, "bold $text-accent"), f"  {plain(choice.label)}{mark}"))
    if question.kind == "number":
        lines.append(Content.styled(f"{question.low:g} to {question.high:g} {question.unit}", "dim"))
    if question.jog is not None:
        jog = question.jog
        moved = ", ".join(f"{v:+.2f}" for v in jog.moved_mm)
        sizes = "  ".join(f"{'›' if n == step else ' '}{n + 1}: {mm:g} mm" for n, mm in enumerate(jog.steps_mm))
        lines += [Content(f"moved by ({moved}) mm, base x y z"), Content(f"step  {sizes}")]
        if jog.refused:
            lines.append(Content.styled(f"! {plain(jog.refused)}", "bold $text-warning"))
    return Content("\n").join(lines)
