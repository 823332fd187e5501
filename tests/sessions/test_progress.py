"""Progress off a terminal: a few plain lines that say how long it will take."""

from __future__ import annotations

import pytest

from brushloop.sessions.terminal import Lines, counted, shown, unseen


def test_a_line_for_each_tenth_says_how_long_the_rest_takes(capsys: pytest.CaptureFixture[str]) -> None:
    times = iter([0.0, *(0.5 * k for k in range(401))])  # begun, then an update every half second
    lines = Lines(lambda: next(times))
    for done in range(401):
        lines.update("captures", done, 400)
    printed = capsys.readouterr().err.splitlines()
    assert printed[:2] == ["captures: 40 of 400, about 3 min left", "captures: 80 of 400, about 3 min left"]
    assert printed[-2:] == ["captures: 360 of 400, about 20 s left", "captures: 400 of 400"]
    assert len(printed) == 10


def test_work_that_ends_within_two_seconds_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with shown() as progress:
        assert list(counted("abc", "letters", 3, progress)) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""


def test_a_resumed_run_is_timed_by_what_it_does_itself(capsys: pytest.CaptureFixture[str]) -> None:
    times = iter([0.0, 0.0, 10.0, 100.0])
    lines = Lines(lambda: next(times))
    for done in (80, 90, 100):
        lines.update("captures", done, 100)
    assert capsys.readouterr().err.splitlines() == ["captures: 90 of 100, about 10 s left", "captures: 100 of 100"]


def test_each_item_is_reported_when_the_next_is_asked_for() -> None:
    counts: list[int] = []
    items = counted("ab", "letters", 2, lambda _what, done, _total: counts.append(done))
    assert (next(items), counts) == ("a", [0])
    assert (list(items), counts) == (["b"], [0, 1, 2])
    unseen("letters", 2, 2)
