"""The app of the first day: shows findings, a picture and the question, and stops the arm by key.

The steps run and ask in a thread of their own, so that nothing they compute keeps a stop waiting on the screen.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.reactive import reactive
from textual.screen import Screen
from textual.widgets import Footer, Input

from brushloop.collect.commission.visit import LeftOff, Tone, Visit, WentBack
from brushloop.collect.engine.snapshot import REFRESH_S
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Prompt, stop_signals
from brushloop.collect.tui.pictures import picture_widget
from brushloop.collect.tui.terminal import PlainApp
from brushloop.collect.tui.widgets import (
    HELP_KEY,
    SHORT_STOP,
    SOFTWARE_STOP,
    STOP,
    YES,
    AskScreen,
    Bar,
    Line,
    Newest,
    one_line,
    plain,
    question_content,
    trouble,
    yes_or_no,
)

AT_WORK = yes_or_no("A step is running: stop it and leave?", "stop and leave", "go on")
STOPPED = "stopped: look at the arm. Run the same command again to resume"
DONE = "Finished: press q to leave."
TYPING_STOP = "ctrl-c: software stop; red button: emergency stop; ctrl-q: leave, all is kept"
TONES: dict[Tone, tuple[str, str]] = {
    "finding": ("", ""),
    "warning": ("! ", "bold $text-warning"),
    "trouble": ("✗ ", "bold $text-error"),
}
Work = Callable[[], Coroutine[Any, Any, Path | None]]


class Steps:
    """The steps of a visit in a thread of their own."""

    def __init__(self, work: Work) -> None:
        """Begin at once."""
        self._stop_sent = False
        self._runner = asyncio.Runner(loop_factory=asyncio.new_event_loop)
        self._loop = self._runner.get_loop()
        self._task = self._loop.create_task(work())
        self.outcome = ThreadPoolExecutor(1, "first day").submit(self._run)
        """The `rig.toml` that was written, or what ended the steps, once they are over."""

    def stop(self) -> None:
        """Cancel what is under way: a driver stops its arm before it lets a cancelled move end. From any thread."""
        self._stop_sent = True
        with contextlib.suppress(RuntimeError):  # the loop has just ended
            self._loop.call_soon_threadsafe(self._task.cancel)

    def _run(self) -> Path | None:
        try:
            with self._runner:
                return self._loop.run_until_complete(self._task)
        except asyncio.CancelledError as stopped:
            # The notes say whether the arm was seen at rest.
            notes = getattr(stopped, "__notes__", [])
            button = "If the arm moves, use the emergency stop, the red button."
            raise CollectAborted(" ".join([*notes, button]) if notes else STOPPED) from None
        except CollectAborted:
            if self._stop_sent:  # a run within the steps has its own word for that
                raise CollectAborted(STOPPED) from None
            raise


class CommissionScreen(Screen[None], inherit_bindings=False):
    """Shows what the visit holds; its keys answer the question."""

    AUTO_FOCUS = "#found"
    HELP = f"""
Every value is kept: run the same command again to resume. Escape takes back the last answer or touch.
Page up and page down show earlier and later results.

{SOFTWARE_STOP} While you type, s is a letter, and only ctrl-c stops.
"""
    DEFAULT_CSS = """
    CommissionScreen #found { width: 1fr; height: 1fr; padding: 0 1; }
    CommissionScreen #picture { width: 36%; height: 100%; padding: 0 1; }
    CommissionScreen.-narrow #picture { display: none; }
    CommissionScreen.-narrow.-picture #picture { display: block; width: 1fr; }
    CommissionScreen.-narrow.-picture #found { display: none; }
    CommissionScreen #question-box {
        height: auto; max-height: 13; padding: 0 1; border: heavy $warning; display: none;
    }
    CommissionScreen.-asking #question-box { display: block; }
    CommissionScreen #answer { display: none; height: 1; border: none; padding: 0; background: $boost; }
    CommissionScreen.-typing #answer { display: block; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        STOP,
        Binding("escape", "back", "Back"),
        Binding("q", "app.quit", "Leave, all is kept"),
        Binding("tab", "picture", "Picture", priority=True),
        HELP_KEY,
    ]
    picture_hidden = reactive(False, bindings=True)

    def __init__(self, visit: Visit) -> None:
        super().__init__()
        self._visit = visit
        self.prompt: Prompt | None = None
        """The question on the screen; None while something is at work."""
        self._title, self._found = Bar("title"), Line("found-text")
        self._asked, self._note = Line("question-text"), Bar("note")
        self._picture = picture_widget("picture")
        self._found_pane = Newest(id="found")
        self._input = Input(id="answer", select_on_focus=False)
        self._over = False

    def compose(self) -> ComposeResult:
        """Lay out the parts from top to bottom."""
        yield self._title
        with Horizontal():
            with self._found_pane:
                yield self._found
            yield self._picture
        with VerticalScroll(id="question-box", can_focus=False):
            yield self._asked
            yield self._input
        yield self._note
        yield Footer(compact=True, show_command_palette=False)

    def action_picture(self) -> None:
        """Show the picture instead of the findings, on a narrow screen."""
        self.toggle_class("-picture")
        if not self.typing:
            self.call_after_refresh(self._found_pane.focus)  # what was hidden lost it

    @property
    def typing(self) -> bool:
        """Whether letters go into a field."""
        return self.prompt is not None and self.prompt.read is not None

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Whether there is a question to go back from, or a picture that has no room beside the findings."""
        own = {"back": self.prompt is not None, "picture": self.picture_hidden}
        return own[action] if action in own else super().check_action(action, parameters)

    def show(self, *, over: bool) -> None:
        """Draw what differs; `over`: the steps are done."""
        visit, prompt = self._visit, self._visit.asker.prompt
        self._title.show(f"First day   {one_line(str(visit.rig_path))}   {plain(visit.step)}")
        picture = visit.picture if visit.live is None else visit.live
        self._picture.show(picture)
        self.picture_hidden = picture is not None and self.has_class("-narrow")
        self.set_class(self.picture_hidden and self.has_class("-picture"), "-picture")
        found = [(text, *TONES[tone]) for tone, text in tuple(visit.findings)]
        self._found.show(Content("\n").join(Content.styled(sign + plain(text), style) for text, sign, style in found))
        if prompt is not self.prompt or over != self._over:
            self._over = over
            self._ask(prompt)
        if prompt is None and not over:
            # Nothing may look as if it hung; and how to stop it is never cut off.
            doing, since_s = visit.doing
            self._note.show(f"{SHORT_STOP}   {one_line(doing or 'at work')}, {time.monotonic() - since_s:.0f} s")

    def _ask(self, prompt: Prompt | None) -> None:
        """Show a question, or that something is at work, or that it is over."""
        self.prompt = prompt
        self.set_class(prompt is not None or self._over, "-asking")
        self.set_class(self.typing, "-typing")
        self._asked.show(DONE if prompt is None else question_content(prompt))
        self._note.show(TYPING_STOP if self.typing else "" if self._over else SHORT_STOP)
        self._input.value = ""
        self._input.placeholder = f"Enter: {prompt.default}" if prompt is not None and prompt.default else ""
        self.set_focus(self._input if self.typing else self._found_pane)
        self._found_pane.anchor()
        self.refresh_bindings()

    def _settle(self, answer: object) -> None:
        if self.prompt is not None:
            self._visit.asker.settle(self.prompt.number, answer)

    def on_key(self, event: events.Key) -> None:
        """Answer, if the key is an answer to the question."""
        answer = None if self.prompt is None else self.prompt.answer_to(event.key, event.character or "")
        if answer is not None:
            event.stop()
            self._settle(answer)

    def action_back(self) -> None:
        """Take the answer before this question back."""
        self._settle(WentBack())

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Take the line, or say why it cannot be taken."""
        if self.prompt is not None and self.prompt.read is not None:
            try:
                self._settle(self.prompt.read(event.value.strip() or self.prompt.default))
            except ValueError as error:
                self._asked.show(Content("\n").join([question_content(self.prompt), trouble(error)]))


class CommissionApp(PlainApp):
    """Shows the steps, and carries the keys to them."""

    def __init__(self, visit: Visit, work: Work) -> None:
        super().__init__()
        self._visit = visit
        self.steps = Steps(work)
        self.first_day = CommissionScreen(visit)
        self._leaving = False

    def on_mount(self) -> None:
        """Look at the steps ten times a second."""
        self.push_screen(self.first_day)
        self.set_interval(REFRESH_S, self._poll)

    def stops(self, event: events.Key) -> bool:
        """Stop keys stop the steps on every screen; `s` is a letter only while a line is typed."""
        typing = self.first_day.typing and self.screen is self.first_day
        return super().stops(event) and not (typing and event.is_printable)

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Whether there is something to stop."""
        return not self.steps.outcome.done() if action == "stop" else super().check_action(action, parameters)

    def action_stop(self) -> None:
        """Stop whatever is under way, and say so at once."""
        self.steps.stop()
        super().action_stop()

    async def action_quit(self) -> None:
        """Leave; where something is at work, ask first."""
        if isinstance(self.screen, AskScreen):
            return
        if self.steps.outcome.done():
            self.exit()
        elif self.first_day.prompt is not None:
            self._visit.asker.abandon(LeftOff)
        else:
            self.push_screen(AskScreen(AT_WORK), lambda key: self.stop_and_leave() if key == YES else None)

    def stop_and_leave(self) -> None:
        """Stop whatever is under way, and end the app once it has stopped. From any thread."""
        self._leaving = True
        self.steps.stop()

    def _poll(self) -> None:
        """Draw; a step that was stopped or failed ends the app, and is reported in the terminal."""
        if not self.is_running or not self.first_day.is_mounted:
            return
        over = self.steps.outcome.done()
        if over and (self._leaving or self.steps.outcome.exception() is not None):
            self.exit()
        else:
            self.first_day.show(over=over)


def run_commission(visit: Visit, work: Work) -> Path | None:
    """Show the screen until the person leaves; returns the `rig.toml` that was written, raises what ended the steps.

    However the screen ends, nobody watches the arm from here on: whatever moves it is stopped.
    """
    app = CommissionApp(visit, work)
    with stop_signals(lambda _: app.stop_and_leave()):
        try:
            app.run()
        finally:
            visit.asker.abandon(LeftOff)
            if not app.steps.outcome.done():
                app.steps.stop()
    return app.steps.outcome.result()
