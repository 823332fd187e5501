"""The screen of the first day: every question is answered by key, and a stop key stops whatever is at work."""

from __future__ import annotations

import asyncio
import contextlib
import re
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from textual.pilot import Pilot

from brushloop.collect.commission.arm import ASK_ADDRESS
from brushloop.collect.commission.brush import ASK_BUS, RADIUS
from brushloop.collect.commission.visit import LeftOff, Visit, WentBack, choice_of
from brushloop.collect.errors import CollectAborted
from brushloop.collect.operator import Choice, Prompt
from brushloop.collect.tui.commission_app import CommissionApp, Steps
from brushloop.collect.tui.widgets import AskScreen
from tests.collect.tui.fake import Asking, brings, shown
from tests.waiting import PATIENCE_S, until


@asynccontextmanager
async def running(asking: Asking) -> AsyncIterator[tuple[CommissionApp, Pilot[None]]]:
    async with asking.app.run_test(size=(80, 24)) as pilot:
        await asking.asked(pilot)
        try:
            yield asking.app, pilot
        finally:
            asking.end()


def asks(prompt: Prompt) -> Callable[[Visit], Awaitable[object]]:
    return lambda visit: visit.ask(prompt)


CHOICE = asks(choice_of("Take this tip?", (Choice("y", "yes, take it"), Choice("n", "no, touch it again")), "y"))
ADDRESS = asks(replace(ASK_ADDRESS, default="192.0.2.7"))


@pytest.mark.parametrize(
    ("question", "keys", "answer"),
    [
        (CHOICE, ["n"], "n"),
        (CHOICE, ["enter"], "y"),
        (lambda visit: visit.yes("Is there a pot of water?"), ["enter", "n"], False),
        (asks(RADIUS), ["2", "6", "enter"], 26),
        (ADDRESS, ["enter"], "192.0.2.7:30004"),
        (asks(ASK_BUS), ["enter"], ""),
        (ADDRESS, ["s", "q", "1", "enter"], "sq1:30004"),
        (brings, ["enter"], True),
        (brings, ["k"], False),
    ],
)
async def test_a_question_is_answered_by_its_keys(
    question: Callable[[Visit], Awaitable[object]], keys: list[str], answer: object
) -> None:
    asking = Asking(question)
    async with running(asking) as (_, pilot):
        await pilot.press(*keys)
        await until(lambda: asking.answers, "the answer")
    assert asking.answers == [answer]


async def test_a_number_out_of_range_is_refused_with_the_range() -> None:
    asking = Asking(asks(RADIUS))
    async with running(asking) as (app, pilot):
        await pilot.press("9", "9", "enter")
        await pilot.pause()
        assert "99 is outside 0.5 to 50 mm" in shown(app)
        assert "Picture" not in shown(app), "there is none"
        assert app.first_day.prompt is not None
    assert asking.answers == []


@pytest.mark.parametrize(("keys", "raised"), [(["escape"], WentBack), (["q"], LeftOff)])
async def test_escape_goes_back_and_q_leaves(keys: list[str], raised: type[Exception]) -> None:
    async with running(Asking(brings)) as (app, pilot):
        await pilot.press(*keys)
        await until(lambda: app.steps.outcome.done(), "the end of the steps")
    with pytest.raises(raised):
        app.steps.outcome.result()


@pytest.mark.parametrize(
    ("key", "ended_by", "leaving"),
    [
        ("s", asyncio.CancelledError(), False),
        ("ctrl+c", asyncio.CancelledError(), False),
        ("s", CollectAborted("stopped"), False),
        ("s", asyncio.CancelledError(), True),
    ],
)
async def test_a_stop_key_stops_what_is_at_work_and_ends_the_screen(
    key: str, ended_by: BaseException, leaving: bool
) -> None:
    """A move that a driver stops, or a run that ends by itself then; also over the question that leaving asks."""
    moves: list[str] = []

    async def move(_visit: Visit) -> None:
        moves.append("at work")
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            moves.append("stopped")
            raise ended_by from None

    async with running(Asking(CHOICE, move)) as (app, pilot):
        await pilot.press("y")
        await until(lambda: moves and app.first_day.prompt is None, "a move")
        await pilot.pause()
        assert re.search(r"s: software stop; red button: emergency stop   at work, \d+ s", shown(app))
        if leaving:
            await pilot.press("q")
            await pilot.pause()
            assert isinstance(app.screen, AskScreen)
        await pilot.press(key)
        await until(lambda: not app.is_running, "the end of the screen")
    assert moves == ["at work", "stopped"]
    with pytest.raises(CollectAborted, match=r"look at the arm\. Run the same command again"):
        app.steps.outcome.result()


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
        steps.outcome.result()
