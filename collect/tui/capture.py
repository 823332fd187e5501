"""The newest capture: its photograph, the binarised image that is compared, the model's, and how it was judged."""

from __future__ import annotations

from typing import TYPE_CHECKING

from textual.app import ComposeResult
from textual.containers import Horizontal, Vertical
from textual.content import Content

from collect.quality.verdict import Check
from collect.tui.line import Line
from collect.tui.pictures import Pictures, binary_picture

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from collect.engine.last_capture import LastCapture

A_LINE, CHECK_WIDTH = 3, 16
"""Checks in a line: as many as the pane of 120 columns has room for."""


class CapturePane(Vertical):
    """One `LastCapture`."""

    DEFAULT_CSS = """
    CapturePane { height: 1fr; }
    CapturePane #capture-words { height: auto; max-height: 50%; }
    CapturePane #capture-pictures { height: 1fr; min-height: 4; }
    CapturePane #photo, CapturePane #binary { margin-right: 1; }
    """

    def __init__(self, pictures: Pictures) -> None:
        super().__init__(id="capture-pane", classes="pane")
        self.border_title = "Last capture: photograph, binarised, CCD-BSM"
        self._words = Line("capture-words")
        self._photo, self._binary, self._model = (pictures.make(name) for name in ("photo", "binary", "model"))
        self._shown: LastCapture | None = None
        self._flat: NDArray[np.uint8] | None = None

    def compose(self) -> ComposeResult:
        """Words above, pictures below."""
        yield self._words
        with Horizontal(id="capture-pictures"):
            yield self._photo
            yield self._binary
            yield self._model

    def show(self, last: LastCapture | None) -> None:
        """Draw it, if it is another one."""
        if last is None:
            self._words.show(Content.styled("nothing captured by this process yet", "dim"))
            return
        if last is self._shown:
            return
        self._shown = last
        self._words.show(capture_words(last))
        self._photo.show(last.photo)
        self._binary.show(None if last.binary is None else binary_picture(last.binary))
        self._model.show(None if last.model is None else binary_picture(last.model))


def capture_words(last: LastCapture) -> Content:
    """Name, verdict, and each check with its limit."""
    kept = ("✓ counts", "bold $text-success") if last.kept else ("! does not count", "bold $text-warning")
    head = Content.assemble((last.stroke_id, "bold"), f"  H {last.height_mm:g} mm  α {last.tilt_deg:g}°  ", kept)
    lines = [head]
    if last.verdict is None:
        lines.append(Content.styled("not judged: [quality] is switched off", "dim"))
    else:
        if last.verdict.reason:
            lines.append(Content.styled(last.verdict.reason, "$text-warning"))
        checks = [_check(check) for check in last.verdict.checks]
        lines += [Content("  ").join(checks[k : k + A_LINE]) for k in range(0, len(checks), A_LINE)]
    if last.model is not None:
        like = "" if last.likeness is None else f": CSIM {100.0 * last.likeness:.1f} % in mm"
        lines.append(Content.styled(f"CCD-BSM as published for this H and α, right{like}", "dim"))
    return Content("\n").join(lines)


def _check(check: Check) -> Content:
    sign, style = ("✓", "") if check.passed else ("!", "bold $text-warning")
    score = f"{check.score:.2f}" if abs(check.score) < 10.0 else f"{check.score:.0f}"
    # In columns: a line that is broken anywhere would part the sign from its check.
    return Content.styled(f"{sign} {check.name} {score}".ljust(CHECK_WIDTH), style)
