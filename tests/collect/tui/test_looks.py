"""What the screens look like, one picture each, compared with accepted ones (`--snapshot-update` takes new ones)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from textual.pilot import Pilot
from textual.widgets import Input

from brushloop.collect.engine.control import State
from brushloop.collect.tui.app import OperatorApp
from brushloop.collect.tui.finish_screen import FinishScreen
from brushloop.sessions.verify import Verdict
from tests.collect.tui.fake import (
    FAILED,
    SPLIT,
    TOUCHED,
    FakeEngine,
    capture,
    full_picture,
)
from tests.collect.tui.fake_browser import FakeBrowser, a_review
from tests.collect.tui.teach_fake import Asking, app_of

SMALL, LARGE = (80, 24), (120, 40)
NOW = {
    "running": full_picture(),
    "failed": FAILED,
    "asking": full_picture(state=State.ASKING, prompt=SPLIT),
    "set-up": full_picture(state=State.ASKING, step="zero touch", prompt=TOUCHED),
}
Press = Callable[[Pilot[None]], Awaitable[None]]


@pytest.fixture(autouse=True)
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)


def pressing(*keys: str) -> Press:
    async def press(pilot: Pilot[None]) -> None:
        await settled(pilot)
        if keys:
            await pilot.press(*keys)
            await settled(pilot)

    return press


async def settled(pilot: Pilot[None]) -> None:
    """As many polls as all parts of the screen take turns in, once it is laid out, and every worker's work."""
    engine = pilot.app.engine  # pyright: ignore[reportAttributeAccessIssue]
    enough = engine.looks + 5 if engine is not None else 0
    while engine is not None and engine.looks < enough:
        await pilot.pause(0.02)
    await pilot.app.workers.wait_for_complete()
    await pilot.pause()


@pytest.mark.parametrize("name", NOW)
def test_run(snap_compare: Callable[..., bool], name: str) -> None:
    app = OperatorApp(FakeEngine(NOW[name]), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=SMALL, run_before=pressing())


def test_a_large_run(snap_compare: Callable[..., bool]) -> None:
    app = OperatorApp(FakeEngine(full_picture()), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=LARGE, run_before=pressing())


@pytest.mark.parametrize(("name", "keys"), [("capture", ["tab"]), ("help", ["?"])])
def test_over_the_run(snap_compare: Callable[..., bool], name: str, keys: list[str]) -> None:
    app = OperatorApp(FakeEngine(full_picture()), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=SMALL, run_before=pressing(*keys))


def test_start(snap_compare: Callable[..., bool]) -> None:
    app = OperatorApp(browser=FakeBrowser(), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=SMALL, run_before=pressing("d"))


def test_review(snap_compare: Callable[..., bool], tmp_path: Path) -> None:
    app = OperatorApp(browser=FakeBrowser(), now_s=lambda: 1010.0)

    async def review(pilot: Pilot[None]) -> None:
        await settled(pilot)
        app.push_screen(a_review(tmp_path))
        await settled(pilot)
        await pilot.pause(0.2)
        await settled(pilot)

    assert snap_compare(app, terminal_size=SMALL, run_before=review)


def test_the_end_of_a_session(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch) -> None:
    sound = Verdict("2026-11-21-grid-01", "closed", files=44, strokes=12, messages=22528)
    monkeypatch.setattr("brushloop.collect.tui.finish_screen.verify", lambda _folder: sound)
    app = OperatorApp(browser=FakeBrowser(), now_s=lambda: 1010.0)

    async def finish(pilot: Pilot[None]) -> None:
        await settled(pilot)
        app.push_screen(FinishScreen(Path("sessions/2026-11-21-grid-01"), is_open=False))
        await settled(pilot)

    assert snap_compare(app, terminal_size=SMALL, run_before=finish)


@pytest.mark.parametrize("kind", ["jog", "choose"])
def test_first_day(snap_compare: Callable[..., bool], kind: str) -> None:
    app = app_of(Asking(kind))

    async def asked(pilot: Pilot[None]) -> None:
        while not app._screen.asking:
            await pilot.pause(0.02)
        for field in app.screen.query(Input):
            field.cursor_blink = False  # on a busy machine the picture may be taken while it is dark
        await pilot.pause()

    try:
        assert snap_compare(app, terminal_size=SMALL, run_before=asked)
    finally:
        app.teaching.stop()
        app.teaching._thread.join()


def test_a_capture_large(snap_compare: Callable[..., bool]) -> None:
    app = OperatorApp(FakeEngine(full_picture(last=capture(kept=False))), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=LARGE, run_before=pressing("enter"))


def test_no_colour(snap_compare: Callable[..., bool], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_COLOR", "1")
    app = OperatorApp(FakeEngine(full_picture()), now_s=lambda: 1010.0)
    assert snap_compare(app, terminal_size=LARGE, run_before=pressing())
