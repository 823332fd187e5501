"""While a photograph is judged, the arm goes where the next dip begins; the decision still comes before the dip."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

import pytest

from brushloop.collect.engine.engine import Engine
from brushloop.collect.engine.steps import capture as capturing
from brushloop.collect.engine.steps.context import meanwhile
from brushloop.collect.errors import BadPicture, CollectAborted
from brushloop.collect.motion import Procedures
from tests.journal_lines import read_lines
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab


def events(lab: Lab) -> list[tuple[str, str]]:
    [folder] = lab.sessions.iterdir()
    lines = list(read_lines(folder / "journal.jsonl"))
    kinds = {line["key"]: str(line["kind"]) for line in lines if line["event"] == "begin"}
    return [(str(line["event"]), kinds[line["key"]]) for line in lines if "key" in line]


def away_from_park_mm(engine: Engine) -> float:
    tip_mm = engine.snapshot().tip_mm
    return 0.0 if tip_mm is None else math.dist(tip_mm, engine._rig_config.motion.park_mm)


def test_a_capture_is_judged_on_the_way_to_the_well_and_decided_before_the_dip(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine, look = lab.engine(), capturing._looked_at

    async def once_under_way(*arguments: Any) -> Any:
        async with asyncio.timeout(10.0):
            while engine.snapshot().strokes_done == 0 and away_from_park_mm(engine) < 20.0:
                await asyncio.sleep(0.001)
        return await look(*arguments)

    monkeypatch.setattr(capturing, "_looked_at", once_under_way)
    engine.start()
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 2
    assert engine.snapshot().parked, "the arm does not wait over the well for a dip that does not come"
    recorded = events(lab)
    after_captures = [recorded[at + 1] for at, one in enumerate(recorded[:-1]) if one == ("begin", "capture")]
    assert after_captures == [("done", "capture")] * 2


def test_every_stroke_has_one_dip_and_the_arm_does_not_set_out_after_the_last(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    went: list[str] = []
    for name in ("set_out", "dip", "press", "capture"):
        method = getattr(Procedures, name)

        async def noted(*arguments: Any, _name: str = name, _method: Any = method, **options: Any) -> Any:
            went.append(_name)
            return await _method(*arguments, **options)

        monkeypatch.setattr(Procedures, name, noted)
    engine = lab.engine()
    engine.start()
    wait_for_end(engine)
    assert went[went.index("dip") :] == ["dip", "press", "capture", "set_out", "dip", "press", "capture"]


def test_a_stop_while_a_capture_is_judged_costs_a_photograph_and_no_press(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    judging = asyncio.Event()

    async def for_ever(*_: Any) -> Any:
        judging.set()
        await asyncio.Event().wait()

    with monkeypatch.context() as patch:
        patch.setattr(capturing, "_looked_at", for_ever)
        engine = lab.engine()
        engine.start()
        until(engine, lambda _: judging.is_set())
        engine.stop()
        with pytest.raises(CollectAborted):
            wait_for_end(engine)
    assert events(lab)[-2:] == [("begin", "capture"), ("void", "capture")]

    again = lab.engine()
    again.start()
    wait_for_end(again)
    assert again.snapshot().strokes_done == 2
    assert len([press for press in lab.rig.world.presses if press.depth_mm > 1.0]) == 2


async def test_a_photograph_at_fault_does_not_stop_the_arm_on_its_way() -> None:
    arrived = False

    async def moving() -> None:
        nonlocal arrived
        await asyncio.sleep(0.01)
        arrived = True

    async def judging() -> None:
        raise BadPicture("too dark")

    with pytest.raises(BadPicture):
        await meanwhile(moving(), judging())
    assert arrived


async def test_of_a_failed_motion_and_a_failed_photograph_the_motion_is_reported() -> None:
    async def failing(error: Exception) -> None:
        raise error

    with pytest.raises(RuntimeError, match="protective stop"):
        await meanwhile(failing(RuntimeError("protective stop")), failing(BadPicture("too dark")))
