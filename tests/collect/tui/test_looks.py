"""What the screens look like, one picture each, compared with accepted ones (`--snapshot-update` takes new ones)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from textual.pilot import Pilot

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.tui.review_screen import ReviewScreen
from tests.collect.tui import fake

SMALL, LARGE = (80, 24), (120, 40)


@pytest.fixture(autouse=True)
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)


def pressing(keys: str = "") -> Callable[[Pilot[None]], Awaitable[None]]:
    async def press(pilot: Pilot[None]) -> None:
        await fake.settled(pilot)
        if keys:
            await pilot.press(keys)
            await fake.settled(pilot)

    return press


@pytest.mark.parametrize(
    ("now", "size", "keys"),
    [
        pytest.param(fake.full_picture(), SMALL, "", id="running"),
        pytest.param(fake.full_picture(), LARGE, "", id="large"),
        pytest.param(fake.FAILED, SMALL, "", id="failed"),
        pytest.param(fake.full_picture(state=State.ASKING, prompt=fake.SPLIT), SMALL, "", id="asking"),
        pytest.param(
            fake.full_picture(state=State.ASKING, step="zero touch", prompt=fake.TOUCHED), SMALL, "", id="set-up"
        ),
        pytest.param(fake.full_picture(), SMALL, "tab", id="capture"),
        pytest.param(fake.full_picture(), SMALL, "?", id="help"),
        pytest.param(fake.full_picture(last=fake.capture(kept=False)), LARGE, "enter", id="capture-large"),
    ],
)
def test_run(snap_compare: Callable[..., bool], now: Snapshot, size: tuple[int, int], keys: str) -> None:
    assert snap_compare(fake.app_of(fake.FakeEngine(now)), terminal_size=size, run_before=pressing(keys))


def test_no_colour(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    assert snap_compare(fake.app_of(fake.FakeEngine(fake.full_picture())), terminal_size=LARGE, run_before=pressing())


def test_start(snap_compare: Callable[..., bool]) -> None:
    assert snap_compare(fake.app_of(browser=fake.FakeBrowser()), terminal_size=SMALL, run_before=pressing())


def test_review(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    app = fake.app_of(browser=fake.FakeBrowser())

    async def review(pilot: Pilot[None]) -> None:
        await fake.settled(pilot)
        app.push_screen(ReviewScreen(fake.FakeReview(), lambda: app.at_work))
        await fake.settled(pilot)
        await pilot.pause(0.2)

    assert snap_compare(app, terminal_size=SMALL, run_before=review)


def test_first_day(snap_compare: Callable[..., bool]) -> None:
    asking = fake.Asking(fake.brings)
    try:
        assert snap_compare(asking.app, terminal_size=SMALL, run_before=asking.asked)
    finally:
        asking.end()
