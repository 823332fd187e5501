"""The app of the first day: shows findings, a picture, the pose and the question, and stops the arm by key."""

from __future__ import annotations

import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Footer, Input

from brushloop.collect.errors import CollectAborted, describe
from brushloop.collect.headless import REFRESH_S, stop_signals
from brushloop.collect.operator import Prompt
from brushloop.collect.rig.optics import gray
from brushloop.collect.teach.guide import LeftOff, Shown, StepState, WentBack
from brushloop.collect.tui.pictures import Pictures
from brushloop.collect.tui.question_screens import YES, AskScreen, question_content, yes_or_no
from brushloop.collect.tui.teach_guide import ScreenGuide, Teaching
from brushloop.collect.tui.terminal import PlainApp
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    NARROW_COLUMNS,
    SHORT_STOP,
    SOFTWARE_STOP,
    STOP,
    Line,
    one_line,
    plain,
    tip_text,
    trouble,
)
from brushloop.drivers.devices import Pose

Work = Callable[[ScreenGuide], Coroutine[Any, Any, Path | None]]
AT_WORK = yes_or_no("A step is running: stop it and leave?", "stop and leave", "go on")
STOPPED = "Stopped. Look at the arm before you go on."
DONE = "This is done."
TYPING_STOP = "ctrl-c: software stop; red button: emergency stop; ctrl-q: leave, all is kept"
TONES = {"finding": ("", ""), "warning": ("! ", "bold $text-warning"), "trouble": ("✗ ", "bold $text-error")}


class TeachScreen(Screen[None], inherit_bindings=False):
    """Shows what the guide holds; its keys answer the question."""

    HELP = f"""
Everything taught is kept; the same command resumes. Escape takes the answer or touch before the question back.
Page up and down turn the pages of what was found.

Jog: arrows move along base x and y, page up and down along z, 1 to 4 choose the size of a step. Every step is checked
against the box that is known so far: 25 mm around all touched points and where your hand left the arm, and 5 mm below.
The arm moves at 20 mm/s.

{SOFTWARE_STOP} While you type, s is a letter and ctrl-c the stop.
"""
    DEFAULT_CSS = """
    TeachScreen #title {
        height: 1; padding: 0 1; background: $panel; text-style: bold; text-wrap: nowrap; text-overflow: ellipsis;
    }
    TeachScreen #found { width: 1fr; height: 1fr; padding: 0 1; }
    TeachScreen #picture { width: 36%; height: 100%; padding: 0 1; }
    TeachScreen.-narrow #picture { display: none; }
    TeachScreen.-narrow.-picture #picture { display: block; width: 1fr; }
    TeachScreen.-narrow.-picture #found { display: none; }
    TeachScreen #live { height: auto; padding: 0 1; background: $boost; text-wrap: nowrap; }
    TeachScreen #question-box { height: auto; max-height: 13; padding: 0 1; border: heavy $warning; display: none; }
    TeachScreen.-asking #question-box { display: block; }
    TeachScreen #note { height: 1; padding: 0 1; background: $panel; text-wrap: nowrap; }
    TeachScreen #answer { display: none; height: 1; border: none; padding: 0; background: $boost; }
    TeachScreen.-typing #answer { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("escape", "back", "Back"),
        Binding("g", "app.go_on", "Go on from the last question"),
        Binding("q", "app.leave", "Leave, all is kept"),
        Binding("tab", "picture", "Picture", priority=True),
        HELP_KEY,
    ]

    def __init__(self, guide: ScreenGuide, name: str, pictures: Pictures) -> None:
        super().__init__()
        self._title, self._found = Line("title"), Line("found-text")
        self._live, self._asked, self._note = Line("live"), Line("question-text"), Line("note")
        self._picture = pictures.make("picture")
        self._found_pane = VerticalScroll(id="found", can_focus=False)
        self._guide = guide
        self._name = name
        self.prompt: Prompt | None = None
        """The question on the screen; None while something is at work."""
        self._findings: tuple[Shown, ...] | None = None
        self._input = Input(id="answer", select_on_focus=False)
        self._over = ""
        self._stop_sent = False

    def compose(self) -> ComposeResult:
        """Lay out the parts from top to bottom."""
        yield self._title
        with Horizontal():
            with self._found_pane:
                yield self._found
            yield self._picture
        yield self._live
        with VerticalScroll(id="question-box", can_focus=False):
            yield self._asked
            yield self._input
        yield self._note
        yield Footer(compact=True, show_command_palette=False)

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
        return self.prompt is not None and self.prompt.read is not None

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Whether there is a question to go back from."""
        return self.prompt is not None if action == "back" else super().check_action(action, parameters)

    def follow(self, guide: ScreenGuide) -> None:
        """Show another run of the steps."""
        self._guide = guide

    def stop_sent(self) -> None:
        """Show at once that a stop key was pressed."""
        self._note.show(Content.styled(" STOP SENT ", "bold reverse"))
        self._stop_sent = True

    def show(self, over: str = "") -> None:
        """Draw what differs. `over` says how it ended, once it has."""
        now, prompt = self._guide, self._guide.asker.prompt
        self._title.show(f"First day   {one_line(self._name)}{_where(now.steps)}")
        self._live.show("no pose: the arm is not read now" if now.tip is None else _tip_text(now.tip, now.tip_known))
        picture = now.live if now.looking and now.live is not None else now.picture
        self._picture.show(None if picture is None else gray(picture))
        new_findings, new_prompt = now.findings is not self._findings, prompt is not self.prompt
        if new_findings:
            self._findings = now.findings
            self._found.show(Content("\n").join(_finding(shown) for shown in now.findings))
        if new_prompt or over != self._over:
            self._over = over
            self._ask(prompt, over)
        if new_findings or new_prompt:
            # Only after the layout is it known where the end is: the question takes its room from the findings.
            self.call_after_refresh(self._found_pane.scroll_end, animate=False)
        if prompt is None and not over and not self._stop_sent:
            self._note.show(_busy_text(*now.doing, self.size.width - 2))

    def _ask(self, prompt: Prompt | None, over: str) -> None:
        """Show a question, or that something is at work, or that it is over."""
        self.prompt, self._stop_sent = prompt, False
        self.set_class(prompt is not None or bool(over), "-asking")
        self.set_class(self.typing, "-typing")
        self._asked.show(over if prompt is None else question_content(prompt))
        self._note.show(TYPING_STOP if self.typing else "" if over else SHORT_STOP)
        self._input.value = ""
        self._input.placeholder = f"Enter: {prompt.default}" if prompt is not None and prompt.default else ""
        self.set_focus(self._input if self.typing else None)
        self.refresh_bindings()

    def on_key(self, event: events.Key) -> None:
        """Answer, if the key is an answer to the question; else page through the findings."""
        answer = None if self.prompt is None else self.prompt.answer_to(event.key, event.character or "")
        if self.prompt is not None and answer is not None:
            event.stop()
            self._guide.asker.settle(self.prompt.number, answer)
        elif event.key in ("pageup", "pagedown"):
            (self._found_pane.scroll_page_up if event.key == "pageup" else self._found_pane.scroll_page_down)()

    def action_back(self) -> None:
        """Take the answer before this question back."""
        if self.prompt is not None:
            self._guide.asker.settle(self.prompt.number, WentBack())

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the line, or say why it cannot be taken."""
        if self.prompt is not None and self.prompt.read is not None:
            try:
                answer = self.prompt.read(event.value.strip() or self.prompt.default)
            except ValueError as error:
                self._note.show(trouble(error))
            else:
                self._guide.asker.settle(self.prompt.number, answer)


def _where(steps: tuple[StepState, ...]) -> str:
    """Number, title and duration of the current step."""
    for number, step in enumerate(steps, 1):
        if step.state == "current":
            return f"   step {number} of {len(steps)}: {plain(step.title)}, about {step.minutes} min"
    return ""


def _finding(shown: Shown) -> Content:
    sign, style = TONES[shown.tone]
    return Content.styled(sign + "\n".join(plain(line) for line in shown.lines), style)


def _busy_text(doing: str, since_s: float, columns: int) -> str:
    """What is at work, and for how long: nothing may look as if it hung. How to stop is never cut off."""
    after = f", {max(time.monotonic() - since_s, 0.0):.0f} s; {SHORT_STOP}"
    what, room = one_line(doing or "at work"), max(columns - len(after), 0)
    return (what if len(what) <= room else f"{what[: room - 1]}…") + after


def _tip_text(tip: Pose, known: bool) -> str:
    return f"{'tip' if known else 'flange'}  {tip_text(tip.position_mm)}"


class TeachApp(PlainApp):
    """Runs the steps, shows them, and carries the keys to them."""

    BINDINGS: ClassVar[list[BindingType]] = [Binding("ctrl+q", "quit", "Leave", show=False, priority=True)]

    def __init__(self, work: Work, name: str, pictures: Pictures | None = None) -> None:
        super().__init__()
        self._work = work
        self.teaching = Teaching(work)
        self.first_day = TeachScreen(self.teaching.guide, name, pictures or Pictures())
        self._ending = False
        self._signalled = False

    def on_mount(self) -> None:
        """Start the steps; then look ten times a second."""
        self.push_screen(self.first_day)
        self.teaching.start()
        self.set_interval(REFRESH_S, self._poll)

    def stops(self, event: events.Key) -> bool:
        """Stop keys stop the steps on every screen; `s` is a letter only while a line is typed."""
        typing = self.first_day.typing and self.screen is self.first_day
        return not self.teaching.finished and not (typing and event.is_printable)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Disable the keys that would do nothing now."""
        match action:
            case "stop":
                return not self.teaching.finished and not self.first_day.typing
            case "leave" | "help":
                return not self.first_day.typing
            case "go_on":
                return self.teaching.finished and self.teaching.stopped and self.teaching.error is None
            case _:
                return super().check_action(action, parameters)

    def action_stop(self) -> None:
        """Stop whatever is under way, and say so at once."""
        self.teaching.stop()
        if self.first_day.is_mounted:
            self.first_day.stop_sent()

    async def action_quit(self) -> None:
        """Leave, while a line is typed too."""
        self.action_leave()

    def action_leave(self) -> None:
        """Leave; where something is at work, ask first."""
        if isinstance(self.screen, AskScreen):
            return
        if self.teaching.finished:
            self.exit()
        elif self.first_day.prompt is not None:
            self._ending = True
            self.teaching.guide.asker.abandon(LeftOff)
        else:
            self.push_screen(AskScreen(AT_WORK), lambda key: self._stop_and_leave() if key == YES else None)

    def _stop_and_leave(self) -> None:
        self._ending = True
        self.action_stop()

    def action_go_on(self) -> None:
        """After a stop, start the steps again; what the notebook already holds is not asked again."""
        self.teaching = Teaching(self._work, self.teaching.guide.findings)
        self.first_day.follow(self.teaching.guide)
        self.teaching.start()

    def leave_soon(self) -> None:
        """End the app, from any thread: a signal came."""
        self._signalled = True

    def _poll(self) -> None:
        if not self.is_running or not self.first_day.is_mounted:
            return
        over = ""
        if self.teaching.finished:
            error = self.teaching.error
            if self._signalled or isinstance(error, CollectAborted) or (self._ending and error is None):
                self.exit()
                return
            over = describe(error) if error is not None else STOPPED if self.teaching.stopped else DONE
        self.first_day.show(over)


def run_teaching(work: Work, name: str, pictures: Pictures | None = None) -> Path | None:
    """Show the screen until the person leaves; returns the `rig.toml` that was written, raises what ended the steps.

    However the screen ends, nobody watches the arm from here on: whatever moves it is stopped.
    """
    app = TeachApp(work, name, pictures)

    def on_signal(_: int) -> None:
        app.teaching.stop()
        app.leave_soon()

    with stop_signals(on_signal):
        try:
            app.run()
        finally:
            if not app.teaching.finished:
                app.teaching.stop()
    app.teaching.join()
    if app.teaching.stopped:
        raise CollectAborted("stopped; the same command resumes from there")
    return app.teaching.written
