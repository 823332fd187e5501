"""What a journal holds about takes that did not count, and of where the paper was found."""

from __future__ import annotations

import pytest

from brushloop.sessions.events import DipResult, StepResult, ZeroTouchResult
from brushloop.sessions.recording import history_of


def did(store, *results: StepResult) -> None:
    for number, result in enumerate(results):
        store.done(store.begin(f"k{number}", result.kind), result)


def test_takes_that_did_not_count_are_distinguished_from_strokes_that_were_given_up(make, store) -> None:
    touches = ZeroTouchResult(method="taught", touch_z_mm=120.0), ZeroTouchResult(method="jog", touch_z_mm=122.0)
    did(
        store,
        touches[0],
        make.captured("a", 1, kept=False, retake=True),
        make.captured("a", 2),
        make.captured("b", 3, kept=False),
        DipResult(skipped=make.press("c")),
        DipResult(),
        touches[1],
    )
    history = history_of(store.folder)
    assert history is not None
    assert (history.photographed, history.pressed_again, history.left_out) == (3, ("a",), ("b", "c"))
    assert history.touches == touches
    assert history.moved_mm == pytest.approx(2.0)


def test_a_folder_without_a_journal_shows_nothing(tmp_path) -> None:
    assert history_of(tmp_path) is None
