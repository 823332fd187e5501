"""What the large view of a capture shows: its pictures, what was predicted for it, and its checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from brushloop.collect.tui.pictures import binary_picture
from brushloop.collect.tui.text import condition_text

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from brushloop.collect.engine.last_capture import LastCapture
    from brushloop.collect.quality.verdict import Check
    from brushloop.sessions import records
    from brushloop.sessions.events import Press

    AnyCheck = Check | records.Check
    """A check of a capture, from the running engine or from a recording."""

WHITE, BOTH, CAPTURED, PREDICTED = (255, 255, 255), (165, 165, 165), (213, 94, 0), (0, 114, 178)
"""Colours of a difference, as in the reports: after Okabe and Ito, which colour-blind readers can distinguish."""
PHOTO_GRAYS = 12
OVERLAY_PX = 384
LINE_PX = 3


@dataclass(frozen=True, slots=True, eq=False)
class LargeCapture:
    """One capture, for the large view."""

    title: str
    photo: NDArray[np.uint8] | None
    binary: NDArray[np.bool_] | None
    predicted: NDArray[np.bool_] | None
    """Mark that a model predicts on the field of `binary`; None without one."""
    model: str
    """Which model that is, or why there is none."""
    csim: float | None
    checks: tuple[AnyCheck, ...]

    def pictures(self) -> dict[str, NDArray[np.uint8]]:
        """The pictures there are, by name, in the order in which they are shown."""
        found: dict[str, NDArray[np.uint8]] = {}
        if self.photo is not None:
            found["photograph"] = self.photo
        if self.binary is not None:
            found["binarised"] = binary_picture(self.binary)
            if self.predicted is not None:
                if self.photo is not None:
                    found["overlay"] = over_photograph(self.photo, self.predicted)
                found["difference"] = difference(self.binary, self.predicted)
        return found


def of_last(last: LastCapture) -> LargeCapture:
    """The newest capture of a run, with CCD-BSM as published."""
    title = title_of(last.press)
    model = "CCD-BSM as published" if last.model is not None else "no prediction for this stroke"
    checks = () if last.verdict is None else last.verdict.checks
    return LargeCapture(title, last.photo, last.binary, last.model, model, last.likeness, checks)


def title_of(press: Press) -> str:
    """The stroke and its command."""
    return f"{press.stroke_id}   {condition_text(press.condition)}"


def over_photograph(photo: NDArray[np.uint8], predicted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The edge of the predicted mark on the photograph of the same field."""
    import cv2
    import numpy as np

    small = cv2.resize(photo, (OVERLAY_PX, OVERLAY_PX), interpolation=cv2.INTER_AREA)
    levels = (np.asarray(small, np.int64) * (PHOTO_GRAYS - 1) + 127) // 255 * 255 // (PHOTO_GRAYS - 1)
    mask = cv2.resize(predicted.astype(np.uint8), (OVERLAY_PX, OVERLAY_PX), interpolation=cv2.INTER_LINEAR)
    edges, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    picture = np.repeat(levels.astype(np.uint8)[..., None], 3, axis=2)
    return np.asarray(cv2.drawContours(picture, edges, -1, PREDICTED, LINE_PX), np.uint8)


def difference(captured: NDArray[np.bool_], predicted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Where both have ink, only the capture has it, and only the prediction has it."""
    import numpy as np

    colours = np.array((WHITE, PREDICTED, CAPTURED, BOTH), np.uint8)
    return colours[2 * captured.astype(np.uint8) + predicted]


def number_text(value: float | None) -> str:
    """A value of a check, as short as it can be read."""
    if value is None:
        return "not measured"
    return f"{value:.2f}" if abs(value) < 10.0 else f"{value:.0f}"


def limit_sign(check: AnyCheck) -> str:
    """`≤` where the value must not exceed the limit, else `≥`; empty without both."""
    if check.score is None or check.threshold is None:
        return ""
    return "≤" if (check.score <= check.threshold) == check.passed else "≥"


def limit_text(check: AnyCheck) -> str:
    """`≤ 0.25 mm`, or nothing for a check without a limit."""
    sign = limit_sign(check)
    return f"{sign} {number_text(check.threshold)} {getattr(check, 'unit', '')}".rstrip() if sign else ""
