"""The screen of the first day: every question is answered by key, and a stop key stops whatever is at work."""

from __future__ import annotations

import asyncio
import contextlib
import re
import threading
from collections.abc import AsyncIterator, Callable
from concurrent.futures import wait
from contextlib import asynccontextmanager

import pytest
from textual.pilot import Pilot

from brushloop.collect.commission.visit import LeftOff, WentBack
from brushloop.collect.errors import CollectAborted
from brushloop.collect.tui.commission_app import CommissionApp, Steps
from brushloop.collect.tui.widgets import AskScreen
from tests.collect.tui.fake import Asking, shown
from tests.waiting import PATIENCE_S, until

SIZE = (80, 24)


@asynccontextmanager
async def running(asking: Asking) -> AsyncIterator[tuple[CommissionApp, Pilot[None]]]:
    app = CommissionApp(asking.visit, asking)
    async with app.run_test(size=SIZE) as pilot:
        await until(lambda: app.first_day.is_mounted and app.first_day.prompt is not None, "the first question")
        await pilot.pause()
        try:
            yield app, pilot
        finally:
            app.steps.stop()
            wait([app.steps._outcome])


async def seen(app: CommissionApp, pilot: Pilot[None], condition: Callable[[], bool]) -> None:
    await until(condition, "what the screen is to show")
    await pilot.pause()


@pytest.mark.parametrize(
    ("kind", "keys", "answer"),
    [
        ("choose", ["n"], "n"),
        ("choose", ["enter"], "y"),
        ("no default", ["enter", "n"], False),
        ("number", ["2", "6", "enter"], 26),
        ("text", ["enter"], "192.0.2.7:30004"),
        ("empty", ["enter"], ""),
        ("text", ["s", "q", "1", "enter"], "sq1:30004"),
        ("bring", ["enter"], True),
        ("bring", ["k"], False),
    ],
)
async def test_a_question_is_answered_by_its_keys(kind: str, keys: list[str], answer: object) -> None:
    asking = Asking(kind)
    async with running(asking) as (app, pilot):
        await pilot.press(*keys)
        await seen(app, pilot, lambda: bool(asking.answers))
    assert asking.answers == [answer]


async def test_a_number_out_of_range_is_refused_with_the_range() -> None:
    asking = Asking("number")
    async with running(asking) as (app, pilot):
        await pilot.press("9", "9", "enter")
        await pilot.pause()
        assert "99 is outside 0.5 to 50 mm" in shown(app)
        assert app.first_day.prompt is not None
    assert asking.answers == []


@pytest.mark.parametrize(("keys", "raised"), [(["escape"], WentBack), (["q"], LeftOff)])
async def test_escape_goes_back_and_q_leaves(keys: list[str], raised: type[Exception]) -> None:
    async with running(Asking("bring")) as (app, pilot):
        await pilot.press(*keys)
        await seen(app, pilot, lambda: app.steps.finished)
    with pytest.raises(raised):
        app.steps.join()


@pytest.mark.parametrize(
    ("key", "work", "leaving"),
    [("s", "move", False), ("ctrl+c", "move", False), ("s", "run", False), ("s", "move", True)],
)
async def test_a_stop_key_stops_what_is_at_work_and_ends_the_screen(key: str, work: str, leaving: bool) -> None:
    """Also over the question that leaving asks meanwhile."""
    asking = Asking("choose", work)
    async with running(asking) as (app, pilot):
        await pilot.press("y")
        await seen(app, pilot, lambda: asking.at_work and app.first_day.prompt is None)
        assert re.search(r"s: software stop; red button: emergency stop   at work, \d+ s", shown(app))
        if leaving:
            await pilot.press("q")
            await pilot.pause()
            assert isinstance(app.screen, AskScreen)
        await pilot.press(key)
        await until(lambda: not app.is_running, "the end of the screen")
    assert asking.stopped_arm
    with pytest.raises(CollectAborted, match=r"look at the arm\. The same command resumes"):
        app.steps.join()


def test_a_second_stop_key_works_at_once() -> None:
    """The first one may end in an error, after which the steps ask how to go on."""
    moving = threading.Event()

    async def moves_twice() -> None:
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(60.0)
        moving.set()
        await asyncio.sleep(60.0)

    steps = Steps(moves_twice)
    steps.stop()
    assert moving.wait(PATIENCE_S)
    steps.stop()
    with pytest.raises(CollectAborted):
        steps.join()
