"""What the screens look like, one picture each, compared with accepted ones (`--snapshot-update` takes new ones)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from textual.pilot import Pilot

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.tui.review_screen import ReviewScreen
from tests.collect.tui.fake import (
    FAILED,
    SPLIT,
    TOUCHED,
    Asking,
    FakeBrowser,
    FakeEngine,
    FakeReview,
    app_of,
    brings,
    capture,
    full_picture,
    settled,
)

SMALL, LARGE = (80, 24), (120, 40)


@pytest.fixture(autouse=True)
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)


def pressing(keys: str = "") -> Callable[[Pilot[None]], Awaitable[None]]:
    async def press(pilot: Pilot[None]) -> None:
        await settled(pilot)
        if keys:
            await pilot.press(keys)
            await settled(pilot)

    return press


@pytest.mark.parametrize(
    ("now", "size", "keys"),
    [
        pytest.param(full_picture(), SMALL, "", id="running"),
        pytest.param(full_picture(), LARGE, "", id="large"),
        pytest.param(FAILED, SMALL, "", id="failed"),
        pytest.param(full_picture(state=State.ASKING, prompt=SPLIT), SMALL, "", id="asking"),
        pytest.param(full_picture(state=State.ASKING, step="zero touch", prompt=TOUCHED), SMALL, "", id="set-up"),
        pytest.param(full_picture(), SMALL, "tab", id="capture"),
        pytest.param(full_picture(), SMALL, "?", id="help"),
        pytest.param(full_picture(last=capture(kept=False)), LARGE, "enter", id="capture-large"),
    ],
)
def test_run(snap_compare: Callable[..., bool], now: Snapshot, size: tuple[int, int], keys: str) -> None:
    assert snap_compare(app_of(FakeEngine(now)), terminal_size=size, run_before=pressing(keys))


def test_no_colour(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    assert snap_compare(app_of(FakeEngine(full_picture())), terminal_size=LARGE, run_before=pressing())


def test_start(snap_compare: Callable[..., bool]) -> None:
    assert snap_compare(app_of(browser=FakeBrowser()), terminal_size=SMALL, run_before=pressing())


def test_review(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    app = app_of(browser=FakeBrowser())

    async def review(pilot: Pilot[None]) -> None:
        await settled(pilot)
        app.push_screen(ReviewScreen(FakeReview(), lambda: app.at_work))
        await settled(pilot)
        await pilot.pause(0.2)

    assert snap_compare(app, terminal_size=SMALL, run_before=review)


def test_first_day(snap_compare: Callable[..., bool]) -> None:
    asking = Asking(brings)
    try:
        assert snap_compare(asking.app, terminal_size=SMALL, run_before=asking.asked)
    finally:
        asking.end()
