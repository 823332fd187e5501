"""A lab drawn from a seed, its person, and the commands that serve it."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest

from brushloop.drivers.sim.lab import UnknownLab
from brushloop.drivers.sim.lab_facts import draw, in_picture
from brushloop.drivers.sim.rig import ControlServer
from brushloop.drivers.sim.world import tool_of
from tests.command import brushloop

SMALL_PX = (640, 480)
FAST = 500.0


def lab_of(seed: int, trap: str | None = None) -> UnknownLab:
    """A lab that does not serve: hand, arm and scene are there, the sockets are not."""
    return UnknownLab(seed, trap, rate=FAST, picture_px=SMALL_PX)


@pytest.mark.parametrize("seed", range(4))
def test_a_seed_is_one_lab_and_one_that_could_be(seed: int):
    facts = draw(seed)
    assert facts == draw(seed) != draw(seed + 1)
    tool, table = facts.config, facts.config.table
    assert 120.0 <= tool.tool_mm <= 260.0
    assert math.hypot(*tool.tool_sideways_mm) <= 15.0
    assert math.degrees(math.acos(tool_of(tool)[2, 2])) <= 3.0
    assert not in_picture(facts.config, [facts.park_mm])
    assert min(table.sheet_mm) > 150.0
    assert max(abs(v) for v in table.slope_deg) <= 1.0


def test_the_cabinet_begins_with_the_tool_and_the_payload_that_somebody_left_in_it():
    lab = lab_of(4)
    assert lab.arcs.cabinet.tcp_offset == list(lab.facts.cabinet_tcp)
    assert lab.arcs.cabinet.payload[0] == lab.facts.payload_kg


def test_the_labels_tell_where_to_connect_and_nothing_that_has_to_be_measured():
    lab = lab_of(4)
    words = " ".join(lab.labels())
    assert lab.host in words
    for hidden in (lab.facts.config.tool_mm, lab.facts.config.table.yaw_deg, lab.facts.pin_mm[0]):
        assert f"{hidden:.1f}" not in words


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"act": "dance"}, "act = 'dance' is not one of bring"),
        ({"act": "bring", "to": "moon"}, "to = 'moon' is not one of pin"),
        ({"act": "bring", "to": "board-corner", "corner": "middle"}, "corner = 'middle' is not one of lower left"),
        ({"act": "measure", "to": "weight"}, "to = 'weight' is not one of square"),
    ],
)
async def test_what_a_person_cannot_do_is_named(request_: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        await lab_of(4).hand(**request_)


async def test_a_person_at_the_command_line_guides_the_arm(tmp_path: Path):
    lab, socket = lab_of(4), tmp_path / "lab.sock"
    async with ControlServer(lab, socket):
        words = ("sim", "hand", socket, "bring", "board-corner", "--corner", "lower left")
        ran = await asyncio.to_thread(brushloop, *words)
        assert ran.stdout == "The tip is at the board-corner, lower left.\n"
