"""Pairs by name, scored against the brush's own repeatability; captures drawn by the model itself."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pytest

from brushloop.calibrate.compare import Alignment, Tone
from brushloop.calibrate.loop import (
    AGAIN,
    ANOTHER,
    SIMULATED,
    Pair,
    pair_up,
    score_pairs,
    statistics_of,
)
from brushloop.calibrate.presses import Press, prepare_job, press_of
from brushloop.model.ccdbsm import Brush
from brushloop.model.raster import coverage
from brushloop.model.strokes import stroke_model
from brushloop.sessions.messages import encode_png
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Header, Source, Stroke
from tests.calibrate.given import CALIBRATION
from tests.calibrate.records import loop_record

MODEL = stroke_model("ccd-bsm", Brush())
ANCHOR, PATCH = (60.0, 40.0), (30.0, 28.0, 40.0, 24.0)
STRICT = (Alignment.MM, Tone.BINARY)
HEADER = Header(session_id="grid", source=Source.LOOPBACK, software="test")


def photograph(depth_mm: float, tilt_deg: float) -> np.ndarray:
    """100 x 80 mm at 10 px/mm, straight from above, with the model's mark at the anchor."""
    axis_x = ANCHOR[0] + depth_mm * math.tan(math.radians(tilt_deg))
    mark = coverage(MODEL.profile(depth_mm, tilt_deg), (axis_x, 80.0 - ANCHOR[1]), size_px=1000, px_mm=0.1)
    return np.rint(230.0 * (1.0 - 0.92 * mark[0][:800])).astype(np.uint8)


def press(name: str, shown: tuple[float, float], asked: tuple[float, float], of: str | None = None) -> Press:
    stroke = Stroke(
        stroke_id=name,
        kind="press",
        still=0,
        depth_mm=asked[0],
        tilt_deg=asked[1],
        cell_mm=PATCH,
        anchor_mm=ANCHOR,
        again_of=of,
    )
    capture = Capture(stroke, encode_png(photograph(*shown)), f"test {name}")
    return press_of(HEADER, stroke, prepare_job((capture, CALIBRATION)))


def paired(originals: Iterable[Press], again: Iterable[Press]) -> tuple[list[Pair], dict[str, str]]:
    """Pairs, and why presses are in none."""
    refused: list[tuple[str, str]] = []
    return pair_up(list(originals), list(again), MODEL, refused), dict(refused)


ORIGINALS = [
    press("a-r01", (14.6, 5.0), (15.0, 5.0)),
    press("a-r02", (15.4, 5.0), (15.0, 5.0)),
    press("b-r01", (19.0, 0.0), (19.0, 0.0)),
]


def test_a_press_made_again_as_it_was_beats_the_other_press_of_its_condition() -> None:
    again = [
        press("a-r01~1", (14.6, 5.0), (14.6, 5.0), "a-r01"),
        press("a-r02~1", (15.4, 5.0), (15.4, 5.0), "a-r02"),
    ]
    pairs, refused = paired(ORIGINALS, again)
    names = [(pair.original.stroke.stroke_id, pair.again.stroke.stroke_id) for pair in pairs]
    assert names == [("a-r01", "a-r01~1"), ("a-r02", "a-r02~1")]
    assert refused == {"b-r01": "was not pressed again"}
    scores = score_pairs(pairs, ORIGINALS)
    csim = {what: scores.of_key(what, STRICT)[:, 0] for what in scores.models}
    assert csim[AGAIN].min() == pytest.approx(1.0)
    assert csim[ANOTHER].max() < 0.98
    assert csim[SIMULATED].mean() > 0.99
    record = loop_record("grid", "ab", stats=tuple(statistics_of(scores)))
    assert len(record.lost) == 8
    assert all(points < 0.0 and row.csim.n == 2 for points, _, _, row in record.lost)
    assert record.answer.good
    assert "so few strokes do not make it certain" in record.answer.text, "two presses of one condition"


def test_a_press_made_again_too_deep_fails_and_says_so() -> None:
    again = [press("a-r01~1", (18.0, 5.0), (18.0, 5.0), "a-r01")]
    scores = score_pairs(paired(ORIGINALS, again)[0], ORIGINALS)
    record = loop_record("grid", "ab", stats=tuple(statistics_of(scores)))
    stat = record.stat(AGAIN, STRICT)
    assert stat is not None
    assert stat.csim.below_ceiling > 2.0
    assert record.answer.good is False


def test_what_repeats_nothing_is_named() -> None:
    again = [
        press("x~1", (15.0, 5.0), (15.0, 5.0), "x"),
        press("y", (15.0, 5.0), (15.0, 5.0)),
        press("a-r01~1", (15.0, 5.0), (15.0, 5.0), "a-r01"),
    ]
    pairs, refused = paired(ORIGINALS, again)
    assert len(pairs) == 1
    assert refused == {
        "x~1": "repeats x: it has no original that can be used",
        "y": "repeats no stroke: it has no original that can be used",
        "a-r02": "was not pressed again",
        "b-r01": "was not pressed again",
    }


def test_an_original_alone_in_its_condition_has_no_repeatability() -> None:
    again = [press("b-r01~1", (19.0, 0.0), (19.0, 0.0), "b-r01")]
    scores = score_pairs(paired(ORIGINALS, again)[0], ORIGINALS)
    assert np.isnan(scores.of(ANOTHER)).all()
    record = loop_record("grid", "ab", stats=tuple(statistics_of(scores)))
    assert (record.lost, record.answer.good) == ([], None)
