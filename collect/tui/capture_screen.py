"""The large view of one capture: a picture as large as the terminal, and its checks, the missed ones first."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, VerticalScroll
from textual.content import Content
from textual.screen import Screen
from textual.widgets import Footer, TabbedContent, TabPane

from brushloop.collect.tui.pictures import binary_picture, picture_widget
from brushloop.collect.tui.widgets import STOP, Bar, Line, condition_text, labelled, one_line, plain

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brushloop.collect.engine.snapshot import LastCapture
    from brushloop.sessions.records import Check

COLOURS = {"both": (166, 166, 166), "captured only": (213, 94, 0), "predicted only": (0, 114, 178)}
"""Colours of a difference, those of `calibrate.report.overlay`."""


def over_photograph(photo: NDArray[np.uint8], predicted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The edge of the predicted mark on the photograph of the same field."""
    import cv2
    import numpy as np

    picture = cv2.cvtColor(cv2.resize(photo, (384, 384)), cv2.COLOR_GRAY2RGB)
    mask = cv2.resize(np.asarray(predicted, np.uint8), (384, 384), interpolation=cv2.INTER_LINEAR)
    edges, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(picture, edges, -1, COLOURS["predicted only"], thickness=3), np.uint8)


def difference(captured: NDArray[np.bool_], predicted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Where both have ink, only the capture has it, and only the prediction has it."""
    import numpy as np

    from brushloop.calibrate.report import overlay

    inks = (np.asarray(mask, np.float32) for mask in (captured, predicted))
    return np.rint(255.0 * overlay(*inks)).astype(np.uint8)


def checks_content(checks: Sequence[Check]) -> Content:
    """A line for each check with value and limit, those missed first, with what to do about them."""
    from brushloop.collect.photograph.checks import Failure

    if_passed = {str(failure): failure.if_passed for failure in Failure}
    lines: list[Content] = []
    for check in sorted(checks, key=lambda check: check.passed):
        sign, style = ("✓", "") if check.passed else ("!", "bold $text-warning")
        name = if_passed.get(check.name, check.name) if check.passed else check.name
        value = f"{sign} {name:<10}{_number(check.score):>6}"
        within = "≤" if (check.score <= check.threshold) == check.passed else "≥"
        limit = f"{within} {_number(check.threshold)} {check.unit}".rstrip()
        lines.append(Content.assemble((value, style), (f"  {limit}", "dim")))
        if check.reason:
            lines.append(Content(plain(check.reason)))
    return Content("\n").join(lines or [Content.styled("not judged", "dim")])


def _number(value: float) -> str:
    return f"{value:.2f}" if abs(value) < 10.0 else f"{value:.0f}"


class CaptureScreen(Screen[None], inherit_bindings=False):
    """One capture; arrows choose the picture."""

    AUTO_FOCUS = "Tabs"
    DEFAULT_CSS = """
    CaptureScreen #pictures { width: 1fr; }
    CaptureScreen #side { width: 36; padding: 0 1; border-left: solid $foreground 40%; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [STOP, Binding("escape,enter,q", "app.pop_screen", "Back")]

    def __init__(self, capture: LastCapture, model: str) -> None:
        """`model` says what predicts the mark of this capture, or why nothing does."""
        super().__init__()
        self._capture, self._model = capture, model
        photo, binary, predicted = capture.photo, capture.binary, capture.model
        self._images: dict[str, NDArray[np.uint8]] = {}
        if photo is not None:
            self._images["photograph"] = photo
        if (picture := binary_picture(binary)) is not None:
            self._images["binarised"] = picture
        if photo is not None and binary is not None and predicted is not None:
            self._images["overlay"] = over_photograph(photo, predicted)
            self._images["difference"] = difference(binary, predicted)

    def compose(self) -> ComposeResult:
        """Lay out the pictures, of which the last says most, beside the checks."""
        title, words = Bar("title"), Line("words")
        press = self._capture.press
        title.show(f"{one_line(press.stroke_id)}   {condition_text(press.condition)}")
        words.show(self._words())
        yield title
        with Horizontal():
            with TabbedContent(initial=next(reversed(self._images), ""), id="pictures"):
                for name, image in self._images.items():
                    picture = picture_widget(f"picture-{name}")
                    picture.show(image)
                    yield TabPane(name, picture, id=name)
            with VerticalScroll(id="side", can_focus=False):
                yield words
        yield Footer()

    def _words(self) -> Content:
        """The checks, then what is compared."""
        checks = () if self._capture.verdict is None else self._capture.verdict.checks
        lines = [checks_content(checks), Content(""), Content.styled(plain(self._model), "bold")]
        if (csim := self._capture.likeness) is not None:
            lines.append(labelled("CSIM", f"{100.0 * csim:.1f} % at true size"))
        if not self._images:
            lines.append(Content("no picture, as the board is not seen in this photograph"))
        if "difference" in self._images:
            for what, colour in COLOURS.items():
                lines.append(Content.assemble(("██", "rgb({},{},{})".format(*colour)), f" {what}"))
        return Content("\n").join(lines)
