"""Progress off a terminal: a plain line now and then."""

from __future__ import annotations

import pytest

from brushloop.sessions.terminal import counted, lines_of, shown, unseen


def test_long_work_prints_a_line_now_and_then(capsys: pytest.CaptureFixture[str]) -> None:
    now_s = 0.0
    update = lines_of(lambda: now_s)
    for done in range(41):
        now_s = 0.5 * done
        update("captures", done, 40)
    printed = capsys.readouterr().err.splitlines()
    assert printed == [f"captures: {done} of 40" for done in (10, 20, 30, 40)]


def test_work_that_ends_soon_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with shown() as progress:
        assert list(counted("abc", "letters", 3, progress)) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""


def test_each_item_is_reported_when_the_next_is_asked_for() -> None:
    counts: list[int] = []
    items = counted("ab", "letters", 2, lambda _what, done, _total: counts.append(done))
    assert (next(items), counts) == ("a", [0])
    assert (list(items), counts) == (["b"], [0, 1, 2])
    unseen("letters", 2, 2)
