"""What a screen shows of a capture, without torch: the model's mark is the one that validation draws."""

from __future__ import annotations

import numpy as np
import pytest

from brushloop.calibrate.compare.place import KEYS, Alignment, Field, Tone, simulated
from brushloop.collect.engine.last_capture import LastCapture, mark_of
from brushloop.model.fitted import FittedPress
from brushloop.model.strokes import stroke_model
from brushloop.sessions.events import Press
from brushloop.sessions.records import Condition

BRUSH = FittedPress(6.0, 48.0)


@pytest.mark.parametrize("depth_mm", [11.0, 15.0, 20.0])
@pytest.mark.parametrize("tilt_deg", [0.0, 5.0, 10.0])
def test_the_mark_is_the_one_of_the_closed_form(depth_mm: float, tilt_deg: float) -> None:
    mark = mark_of(BRUSH, Condition(depth_mm, tilt_deg))
    model = stroke_model("ccd-bsm", BRUSH)
    exact = simulated(model, depth_mm, tilt_deg, Field())[KEYS.index((Alignment.MM, Tone.BINARY))] > 0
    assert mark is not None
    assert exact.sum() > 100
    assert np.logical_xor(mark, exact).sum() <= 0.01 * exact.sum()


def test_beyond_the_domain_there_is_none() -> None:
    assert mark_of(BRUSH, Condition(0.0, 0.0)) is None
    assert mark_of(BRUSH, Condition(11.0, 85.0)) is None


def test_likeness_is_a_cosine_and_needs_ink_on_both() -> None:
    mark = mark_of(BRUSH, Condition(11.0, 0.0))

    def capture(binary: np.ndarray | None) -> LastCapture:
        press = Press(stroke_id="H11-a0-r00", condition=Condition(11.0, 0.0))
        return LastCapture(press, 1, True, None, None, binary, mark)

    assert capture(mark).likeness == pytest.approx(1.0)
    assert capture(np.roll(mark, 60, axis=0)).likeness == pytest.approx(0.0)
    assert capture(None).likeness is None
    assert capture(np.zeros_like(mark)).likeness is None
