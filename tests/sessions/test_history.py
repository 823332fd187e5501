"""What a journal holds about takes that did not count, and of where the paper was found."""

from __future__ import annotations

import pytest

from brushloop.sessions.history import ZeroTouch, history_of


def did(store, key: str, kind: str, result: dict[str, object]) -> None:
    store.done(store.begin(key, kind, patch=None, notes={}), result)


def test_takes_that_did_not_count_are_distinguished_from_strokes_that_were_given_up(store) -> None:
    did(store, "z1", "zero_touch", {"method": "taught", "touch_z_mm": 120.0})
    did(store, "c1", "capture", {"stroke_id": "a", "kept": False, "retake": True})
    did(store, "c2", "capture", {"stroke_id": "a", "kept": True, "retake": False})
    did(store, "c3", "capture", {"stroke_id": "b", "kept": False, "retake": False})
    did(store, "d4", "dip", {"stroke_id": "c", "skipped": True})
    did(store, "d5", "dip", {})
    did(store, "z2", "zero_touch", {"method": "jog", "touch_z_mm": 122.0})
    history = history_of(store.folder)
    assert history is not None
    assert (history.photographed, history.pressed_again, history.left_out) == (3, ("a",), ("b", "c"))
    assert history.found == (ZeroTouch("taught", 120.0), ZeroTouch("jog", 122.0))
    assert history.moved_mm == pytest.approx(2.0)


def test_a_folder_without_a_journal_shows_nothing(tmp_path) -> None:
    assert history_of(tmp_path) is None
