"""From the dip to the press: every press is made alike, the arm sets out for the next dip while a photograph is judged,
and the dip's extras, across the rim after each dip and into water before every so many."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from brushloop.collect.engine import brush as brush_steps
from brushloop.collect.engine import capture as capturing
from brushloop.collect.engine.recorder import meanwhile
from brushloop.collect.engine.snapshot import Progress
from brushloop.collect.errors import BadPicture, CollectAborted, ConfigError
from brushloop.collect.motion import Procedures, dip_moves, wash_moves
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.tui.review_screen import Review
from brushloop.sessions.events import PressResult
from brushloop.sessions.recording import Recording
from tests.rigs import Lab
from tests.runs import ended_by, until, wait_for_end


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the screen said was being done, one after the other."""
    said: list[str] = []
    doing = Progress.doing

    def noted(self: Progress, what: str) -> None:
        said.extend([what] if said[-1:] != [what] else [])
        doing(self, what)

    monkeypatch.setattr(Progress, "doing", noted)
    return said


@pytest.fixture
def went(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the arm did, one after the other."""
    names: list[str] = []
    for name in ("set_out", "dip", "press", "capture"):
        method = getattr(Procedures, name)

        async def noted(*arguments: Any, _name: str = name, _method: Any = method) -> Any:
            names.append(_name)
            return await _method(*arguments)

        monkeypatch.setattr(Procedures, name, noted)
    return names


def test_nobody_looks_at_the_paper_between_dip_and_press(sharp_lab: Lab, went: list[str], screen: list[str]) -> None:
    sharp_lab.run()
    assert went[went.index("dip") :] == ["dip", "press", "capture"]
    assert screen[screen.index("dip") :][:4] == ["dip", "check that the sheet is blank", "dip", "press H13-a0-r01"]
    [wait_s] = [made.press.dip_to_touch_s for made in sharp_lab.state.results(PressResult)]
    assert wait_s is not None
    assert wait_s > 0.0
    [stroke] = Recording(sharp_lab.session).stroke_records()
    assert stroke.dip_to_touch_s == wait_s
    assert [seen.press.dip_to_touch_s for seen in Review(sharp_lab.session).captures] == [wait_s]


def test_a_brush_that_waited_with_its_ink_dips_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, went: list[str], screen: list[str]
) -> None:
    """A pause between dip and press is as good as any length: every wait counts as too long here."""
    monkeypatch.setattr(brush_steps, "STALE_INK_S", 0.0)
    lab.write_protocol("[11.0]", "[0.0]")
    lab.run()
    assert went.count("dip") == 2
    assert screen[screen.index("press H11-a0-r01") :][:3] == ["press H11-a0-r01", "dip", "press H11-a0-r01"]


# The arm goes where the next dip begins; the decision on a photograph still comes before the dip


def test_the_arm_sets_out_for_the_next_dip_while_a_capture_is_judged_and_dips_after_the_decision(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, went: list[str]
) -> None:
    engine, look = lab.engine(), capturing._looked_at

    async def once_under_way(*arguments: Any) -> Any:
        async with asyncio.timeout(10.0):
            while engine.snapshot().strokes_done == 0 and engine.snapshot().parked:
                await asyncio.sleep(0.001)
        seen = await look(*arguments)
        went.append("judged")
        return seen

    monkeypatch.setattr(capturing, "_looked_at", once_under_way)
    engine.start()
    wait_for_end(engine)
    first, last = ["dip", "press", "capture", "set_out", "judged"], ["dip", "press", "capture", "judged"]
    assert went[went.index("dip") :] == first + last, "nor does the arm set out after the last stroke"
    assert engine.snapshot().parked


def test_a_stop_while_a_capture_is_judged_costs_a_photograph_and_no_press(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    judging = asyncio.Event()

    async def for_ever(*_: Any) -> Any:
        judging.set()
        await asyncio.Event().wait()

    with monkeypatch.context() as patch:
        patch.setattr(capturing, "_looked_at", for_ever)
        engine = lab.started()
        until(engine, lambda _: judging.is_set())
        engine.stop()
        ended_by(engine, CollectAborted)
    assert [begin.kind for begin, _ in lab.state.cut] == ["capture"]

    again = lab.run()
    assert again.snapshot().strokes_done == 2
    assert len(lab.presses) == 2


async def test_a_photograph_at_fault_does_not_stop_the_arm_on_its_way_and_a_failed_motion_is_reported_first() -> None:
    arrived: list[bool] = []

    async def moving() -> None:
        await asyncio.sleep(0.01)
        arrived.append(True)

    async def failing(error: Exception) -> None:
        raise error

    with pytest.raises(BadPicture):
        await meanwhile(moving(), failing(BadPicture("too dark")))
    assert arrived
    with pytest.raises(RuntimeError, match="protective stop"):
        await meanwhile(failing(RuntimeError("protective stop")), failing(BadPicture("too dark")))


# Across the rim, and into water

WIPE = "\n[ink.wipe]\nrim_mm = [322.0, 20.0]\nz_mm = 130.0\n"
WASH = "\n[ink.wash]\npot_mm = [305.0, 80.0]\ndip_z_mm = 125.0\nevery_dips = 2\nstrokes = 2\n"


def rig(lab: Lab, extra: str = "") -> RigConfig:
    lab.edit_rig("", extra)
    return load_rig(lab.folder / "rig.toml")


def test_the_brush_leaves_the_well_across_its_rim_and_is_washed_so_often(lab: Lab) -> None:
    plain, config = dip_moves(rig(lab)), rig(lab, WIPE + WASH)
    wiped = dip_moves(config)
    assert [m.target for m in wiped[:2]] == [m.target for m in plain[:2]]
    assert [round(m.target.z_mm) for m in wiped] == [180, 122, 130, 130, 180]
    assert wiped[-1].target.position_mm[:2] == pytest.approx(wiped[-2].target.position_mm[:2])
    assert wiped[-1].target.position_mm[:2] != pytest.approx(plain[-1].target.position_mm[:2])
    assert config.ink.wash is not None
    assert [round(m.target.z_mm) for m in wash_moves(config, config.ink.wash)] == [180, 125, 152, 125, 152, 180]


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (WIPE.replace("322.0", "120.0"), "ink.wipe.rim_mm = .* lies on the sheet"),
        (WIPE.replace("130.0", "250.0"), "ink.wipe.z_mm = 250 is outside"),
        (WASH.replace("305.0", "100.0"), "ink.wash.pot_mm = .* lies on the sheet"),
    ],
)
def test_a_place_on_the_sheet_or_a_height_that_cannot_be_is_refused(lab: Lab, extra: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        rig(lab, extra)
