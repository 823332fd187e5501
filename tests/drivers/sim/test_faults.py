"""Faults of the rig: when one begins, what it strikes, when it is over, and live control of them over a socket."""

from __future__ import annotations

import asyncio
import json
import re
import stat
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.loopback import FaultRefused
from brushloop.drivers.loopback import ask as ask_rig
from brushloop.drivers.sim.brush.spec import SimFileError
from brushloop.drivers.sim.config import SimConfig, Table
from brushloop.drivers.sim.faults import Device, Fault, FaultBoard, Phase, fault_of, phase_of
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.drivers.sim.serve import ControlServer, live_control
from brushloop.drivers.sim.world import World
from tests.drivers.sim.conftest import StoppedClock


class Scripted(FaultBoard):
    """A board over a world whose state is set by the test, and a clock."""

    def __init__(self) -> None:
        self.at_s = 0.0
        self.doing = Phase.PARKED
        self.presses: list[None] = []
        self.clock = self
        super().__init__(self)  # type: ignore[arg-type]

    def real_s(self) -> float:
        return self.at_s

    def phase(self) -> Phase:
        return self.doing

    def strikes(self, *ops: str) -> list[bool]:
        return [self.meet(Device.ROBOT, op) is not None for op in ops]


@pytest.fixture
def world() -> Scripted:
    return Scripted()


def mute(**more: object) -> Fault:
    return Fault.model_validate({"device": "robot", "kind": "mute", **more})


def test_without_conditions_a_fault_strikes_the_next_request_and_is_over(world: Scripted):
    world.hang(mute())
    assert world.strikes("a", "b") == [True, False]
    assert [hung.struck for hung in world.over] == [1]
    assert not world.hanging


def test_a_method_is_named_in_short_or_in_full(world: Scripted):
    world.hang(mute(on="moveLine", count=2))
    ops = ("rob1.MotionControl.getExecId", "rob1.MotionControl.moveLine", "rob1.MotionControl.moveLines", "moveLine")
    assert world.strikes(*ops) == [False, True, False, True]


def test_the_nth_is_counted_among_requests_for_which_all_else_holds(world: Scripted):
    world.hang(mute(on="x", nth=2, phase="descending", count=2))
    assert world.strikes("x", "x") == [False, False]
    world.doing = Phase.DESCENDING
    assert world.strikes("x", "y", "x") == [False, False, True]
    world.doing = Phase.PARKED  # once begun it goes on
    assert world.strikes("y", "x", "x") == [False, True, False]


def test_the_number_of_presses_is_a_condition_too(world: Scripted):
    world.hang(mute(press=3))
    world.presses = [None] * 4
    assert world.strikes("x") == [False]
    world.presses = [None] * 3
    assert world.strikes("x") == [True]


def test_for_so_many_seconds_counts_from_when_it_begins(world: Scripted):
    world.hang(mute(for_s=2.0))
    world.at_s = 100.0
    assert world.strikes("x", "x") == [True, True]
    world.at_s = 101.9
    assert world.strikes("x") == [True]
    world.at_s = 102.0
    assert world.strikes("x") == [False]
    assert [hung.struck for hung in world.over] == [3]


def test_a_stop_begins_by_itself_and_once(world: Scripted):
    fault = Fault(device=Device.ROBOT, kind="emergency-stop", phase=Phase.LIFTING)
    world.hang(fault)
    assert world.meet(Device.ROBOT, "x") is None
    assert world.due() == []
    world.doing = Phase.LIFTING
    assert world.due() == [fault]
    assert world.due() == []


def test_a_fault_of_ink_begins_by_itself_and_strikes_the_requests_that_follow(world: Scripted):
    world.hang(Fault(device=Device.INK, kind="garbage", phase=Phase.LIFTING, count=2))
    assert world.due() == []
    assert world.meet(Device.INK) is None
    world.doing = Phase.LIFTING
    world.due()
    world.doing = Phase.PARKED
    strikes = [world.meet(Device.INK) is not None for _ in range(3)]
    assert strikes == [True, True, False]


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"kind": "loud"}, "kind = 'loud' is not one of robot's: deaf, drop,"),
        ({"device": "coffee"}, "device: Input should be 'robot', 'telemetry'"),
        ({"nht": 3}, "nht: Extra inputs are not permitted"),
        ({"nth": 0}, "nth: Input should be greater than or equal to 1"),
        ({"count": 1, "for_s": 1.0}, "count and for_s exclude each other"),
        ({"device": "telemetry", "on": "moveLine"}, "only the robot has methods"),
        ({"kind": "protective-stop", "count": 2}, "happens once"),
        ({"kind": "emergency-stop", "nth": 2}, "counts nothing here"),
        ({"late_s": 1.0}, "late_s goes with kind = 'late' of robot and telemetry only"),
        ({"a\nb\x1b[31m": 1}, "Extra inputs are not permitted"),
    ],
)
def test_what_cannot_be_used_is_refused_with_one_printable_line(fields: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        fault_of({"device": "robot", "kind": "mute"} | fields)
    assert str(caught.value).isprintable()


TABLE = Table()
OVER, NEAR, ON, IN = ((100.0, 80.0, h) for h in (60.0, 8.0, 0.03, -15.0))
WELL, INK = (*TABLE.well_mm, 60.0), (*TABLE.well_mm, 2.0)
HOME = None
"""Where the tip rests when the rig starts."""


def base(spot: tuple[float, float, float] | None) -> Pose:
    """The pose of a place in the paper frame, in mm above the sheet."""
    return brush_pose(*(SimConfig().home_mm if spot is HOME else TABLE.to_base(*spot)))


@pytest.mark.parametrize(
    ("here", "to", "phase"),
    [
        (HOME, HOME, Phase.PARKED),
        (OVER, OVER, Phase.RESTING),
        (HOME, OVER, Phase.TRAVELLING),
        (OVER, NEAR, Phase.TRAVELLING),  # the fast approach ends above the paper
        (NEAR, ON, Phase.DESCENDING),
        (ON, IN, Phase.DESCENDING),
        (ON, ON, Phase.PRESSED),
        (IN, IN, Phase.PRESSED),
        (IN, NEAR, Phase.LIFTING),
        (NEAR, OVER, Phase.LIFTING),
        (OVER, HOME, Phase.TRAVELLING),
        (HOME, WELL, Phase.TRAVELLING),
        (WELL, INK, Phase.DIPPING),
        (INK, INK, Phase.DIPPING),
        (INK, WELL, Phase.DIPPING),
        (WELL, HOME, Phase.TRAVELLING),
    ],
)
def test_each_piece_of_a_press_and_of_a_dip_has_its_phase(
    here: tuple[float, float, float] | None, to: tuple[float, float, float] | None, phase: Phase
):
    world = World(SimConfig())
    world.clock = clock = StoppedClock()  # type: ignore[assignment]
    world.motion.add(base(here), 200.0, 1000.0, clock.s)
    clock.s = 100.0
    world.motion.add(base(to), 200.0, 1000.0, clock.s)
    assert phase_of(world) is phase


@pytest.mark.parametrize(
    ("above_mm", "phase"), [(3.0, Phase.RESTING), (0.05, Phase.PRESSED), (-2.0, Phase.PRESSED), (60.0, Phase.RESTING)]
)
@pytest.mark.parametrize("corner_mm", [(230.0, 10.0), (10.0, 160.0)])
def test_on_a_sloping_sheet_heights_count_from_the_paper_under_the_tip(
    corner_mm: tuple[float, float], above_mm: float, phase: Phase
):
    table = Table(yaw_deg=0.0, slope_deg=(1.0, -1.0))
    world = World(SimConfig(table=table))
    world.clock = clock = StoppedClock()  # type: ignore[assignment]
    world.motion.add(brush_pose(*table.to_base(*corner_mm, above_mm)), 100.0, 1000.0, clock.s)
    clock.s = 60.0
    assert phase_of(world) is phase


Ask = Callable[[object], Awaitable[dict[str, Any]]]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "control"


@pytest.fixture
async def control(rig: LoopbackRig, path: Path) -> AsyncIterator[Path]:
    async with live_control(rig, path):
        yield path
    assert not path.exists()


@pytest.fixture
async def ask(control: Path) -> AsyncIterator[Ask]:
    reader, writer = await asyncio.open_unix_connection(str(control))

    async def exchange(request: object) -> dict[str, Any]:
        writer.write((request if isinstance(request, bytes) else json.dumps(request).encode()) + b"\n")
        return json.loads(await reader.readline())

    yield exchange
    writer.close()
    await writer.wait_closed()


async def test_a_fault_is_hung_listed_and_taken_down(ask: Ask, rig: LoopbackRig):
    fault = {"device": "robot", "kind": "mute", "on": "moveLine", "nth": 2}
    assert await ask({"do": "add", "fault": fault}) == {"ok": True, "id": 1}
    assert (await ask({"do": "list"}))["hanging"] == [{"id": 1, "fault": fault, "struck": 0}]
    assert await ask({"do": "clear", "id": 7}) == {"ok": True, "taken": 0}
    assert await ask({"do": "clear", "id": 1}) == {"ok": True, "taken": 1}
    await ask({"do": "add", "fault": fault})
    assert await ask({"do": "clear"}) == {"ok": True, "taken": 1}
    assert not rig.faults.hanging


async def test_the_state_is_what_the_world_knows(ask: Ask):
    state = await ask({"do": "state"})
    assert state["ok"]
    assert (state["phase"], state["moving"], state["presses"], state["ink_load"]) == ("parked", False, 0, 0.0)
    assert (state["robot_mode"], state["safety_mode"], state["faults"]) == ("PowerOff", "Normal", 0)
    assert state["tip_mm"] == [250.0, -230.0, 260.0]


@pytest.mark.parametrize(
    ("kind", "mode"),
    [("protective-stop", SafetyMode.PROTECTIVE_STOP), ("emergency-stop", SafetyMode.ROBOT_EMERGENCY_STOP)],
)
async def test_a_person_ends_a_stop_that_was_asked_for(ask: Ask, kind: str, mode: SafetyMode):
    await ask({"do": "add", "fault": {"device": "robot", "kind": kind}})
    while (await ask({"do": "state"}))["safety_mode"] != mode:
        await asyncio.sleep(0.005)
    assert await ask({"do": "release"}) == {"ok": True, "was": mode.value}
    assert (await ask({"do": "state"}))["safety_mode"] == "Normal"
    assert await ask({"do": "release"}) == {"ok": True, "was": "Normal"}


REFUSED: list[tuple[object, str]] = [
    (b"hello", "not JSON"),
    ({"do": "explode"}, "not a request"),
    ({"do": "state", "more": 1}, "not a request"),
    ({"do": "add", "fault": {}}, "Field required"),
]


@pytest.mark.parametrize(("request_", "words"), REFUSED, ids=range(len(REFUSED)))
async def test_what_is_no_request_gets_one_line_and_the_next_is_answered(ask: Ask, request_: object, words: str):
    answer = await ask(request_)
    assert not answer["ok"]
    assert words in answer["error"]
    assert answer["error"].isprintable()
    assert (await ask({"do": "state"}))["ok"]


async def test_only_its_owner_can_open_it(control: Path):
    mode = control.stat().st_mode
    assert stat.S_ISSOCK(mode)
    assert stat.S_IMODE(mode) == 0o600


async def test_what_stands_at_the_path_is_not_overwritten(rig: LoopbackRig, path: Path):
    path.write_text("mine")
    with pytest.raises(SimFileError, match="exists and is not a socket"):
        async with live_control(rig, path):
            pass
    assert path.read_text() == "mine"


async def test_two_rigs_do_not_share_a_socket_and_one_that_is_dead_is_replaced(rig: LoopbackRig, path: Path):
    async with live_control(rig, path):
        with pytest.raises(SimFileError, match="another rig listens here"):
            await ControlServer(rig).open(path)
        path.rename(f"{path}.old")
    assert Path(f"{path}.old").exists()  # what it did not find at its path it left alone
    Path(f"{path}.old").rename(path)
    async with live_control(rig, path):
        _, writer = await asyncio.open_unix_connection(str(path))
        writer.close()
        await writer.wait_closed()


async def test_a_path_that_the_system_would_cut_is_refused(rig: LoopbackRig, tmp_path: Path):
    for path, words in ((tmp_path / ("x" * 120), "too long"), (tmp_path / "no" / "where", "cannot listen here")):
        with pytest.raises(SimFileError, match=words) as caught:
            await ControlServer(rig).open(path)
        assert caught.value.exit_code == 2


async def test_a_person_breaks_the_rig_and_mends_it(control: Path):
    def fault(*words: str) -> Result:
        return CliRunner().invoke(brushloop.__main__.app, ["sim", "fault", str(control), *words])

    added = await asyncio.to_thread(fault, "robot", "mute", "--on", "moveLine", "--count", "3")
    assert json.loads(added.stdout) == {"id": 1}
    refused = await asyncio.to_thread(fault, "robot", "loud")
    assert isinstance(refused.exception, FaultRefused)
    assert str(refused.exception).startswith("kind = 'loud' is not one of robot's")
    assert json.loads((await asyncio.to_thread(fault, "clear")).stdout) == {"taken": 1}


def test_where_no_rig_answers_it_is_said_in_one_line(tmp_path: Path):
    with pytest.raises(FaultRefused, match="no rig answers here") as caught:
        ask_rig(tmp_path / "nobody", {"do": "state"})
    assert caught.value.exit_code == 2
