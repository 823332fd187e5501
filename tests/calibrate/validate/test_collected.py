"""What a report says of how the strokes were collected: takes that did not count, and where the paper was found."""

from __future__ import annotations

import itertools

import pytest

from brushloop.calibrate.validate.report import collected_in
from brushloop.sessions.events import CaptureResult, Condition, DipResult, Press, ZeroTouchResult
from brushloop.sessions.records import Header, Source
from brushloop.sessions.store import SessionStore


def press(stroke_id: str) -> Press:
    return Press(stroke_id=stroke_id, condition=Condition(depth_mm=13.0, tilt_deg=5.0))


def test_takes_that_did_not_count_are_distinguished_from_strokes_that_were_given_up(tmp_path) -> None:
    header = Header(session_id="taken", source=Source.LOOPBACK, software="test")
    store = SessionStore.create(tmp_path / "taken", header, {}, itertools.count(1).__next__)
    results = (
        ZeroTouchResult(method="taught", touch_z_mm=120.0),
        CaptureResult(press=press("a"), still=1, kept=False, retake=True),
        CaptureResult(press=press("a"), still=2),
        CaptureResult(press=press("b"), still=3, kept=False),
        DipResult(skipped=press("c")),
        DipResult(),
        ZeroTouchResult(method="jog", touch_z_mm=122.0),
    )
    for number, result in enumerate(results):
        store.done(store.begin(f"k{number}", result.kind), result)
    store.close()
    store.release()
    collected = collected_in(store.folder)
    assert collected is not None
    assert (collected.photographed, collected.pressed_again, collected.left_out) == (3, ("a",), ("b", "c"))
    assert collected.touches == ("taught 120.00 mm", "jog 122.00 mm")
    assert collected.moved_mm == pytest.approx(2.0)


def test_a_folder_without_a_journal_shows_nothing(tmp_path) -> None:
    assert collected_in(tmp_path) is None
