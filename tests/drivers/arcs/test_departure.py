"""What another client did to the arm since the last line: seen before the next one is sent."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.motion import until_settled
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.arcs.settings import TOOL_OFFSET, require_same
from brushloop.drivers.arcs.wire import RpcConnection
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import ArmMoved, LimitExceeded, NotPowered, RobotNotSafe, SettingsChanged
from brushloop.drivers.geometry import brush_pose, distance
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.rig import HOST

QUICK = {"speed_mm_s": 200.0, "acc_mm_s2": 800.0}
ABOVE, LOW = brush_pose(300.0, -200.0, 200.0), brush_pose(300.0, -200.0, 130.0)
ELSEWHERE = brush_pose(340.0, -180.0, 100.0, tilt_deg=10.0)


@pytest.fixture
async def other(cabinet: ArcsServer) -> AsyncIterator[Controller]:
    """A second client of the same cabinet."""
    client = Controller(RpcConnection(HOST, cabinet.port))
    client.robot = "rob1"
    await client.connection.open()
    yield client
    await client.connection.close()


async def send(client: Controller, target: Pose) -> None:
    """Move the arm there, as a client without any limits would."""
    await client.move_line(target, 200.0, 800.0)
    await until_settled(client.rest, target, planned_s=2.0)


def lines(cabinet: ArcsServer) -> int:
    return cabinet.cabinet.world.motion._next_id


async def test_an_arm_that_was_moved_is_not_sent_anywhere_until_it_is_taken_up(
    arm: AuboArcs, other: Controller, cabinet: ArcsServer
):
    await arm.move(ABOVE, **QUICK)
    await arm.confirm()
    await send(other, ELSEWHERE)
    sent = lines(cabinet)
    for refused in (arm.move(LOW, **QUICK), arm.follow([LOW, ABOVE], blend_mm=1.0, **QUICK), arm.confirm()):
        with pytest.raises(ArmMoved, match=r"109\.\d mm and 10\.0 deg from where it was left") as caught:
            await refused
        assert caught.value.off_deg == pytest.approx(10.0, abs=0.01)
    assert lines(cabinet) == sent
    assert distance(await arm.take_up(), ELSEWHERE)[0] < 0.05
    await arm.move(LOW, **QUICK)


async def test_an_arm_that_somebody_moves_right_now_is_not_fought(
    arm: AuboArcs, other: Controller, cabinet: ArcsServer
):
    await arm.move(ABOVE, **QUICK)
    await other.move_line(LOW, 1.0, 800.0)
    sent = lines(cabinet)
    for refused in (arm.move(ELSEWHERE, **QUICK), arm.take_up(), arm.confirm()):
        with pytest.raises(ArmMoved, match="Wait until it rests") as caught:
            await refused
        assert caught.value.moving
    assert lines(cabinet) == sent, "nothing was queued behind it"
    assert not await other.at_rest(), "and it was not stopped"


TAMPERED: list[tuple[str, dict[str, Any], str]] = [
    ("RobotConfig.setTcpOffset", {"offset": [0.0, 0.0, 0.17, 0.0, 0.0, 0.0]}, r"tool offset is \(0, 0, 170\) mm, "),
    ("RobotConfig.setTcpOffset", {"offset": [0.0, 0.0, 0.18, 0.1, 0.0, 0.0]}, r"\(5.7296, 0, 0\) deg, not \(0, 0, "),
    (
        "RobotConfig.setPayload",
        {"m": 1.0, "cog": [0.0] * 3, "aom": [0.0] * 3, "inertia": [0.0] * 6},
        r"payload is 1 kg, \(0, 0, 0\) mm, not 0 kg",
    ),
    ("RobotConfig.setCollisionLevel", {"level": 1}, "collision level is 1, not 6"),
    ("MotionControl.setSpeedFraction", {"fraction": 0.5}, "speed fraction is 0.5, not 1"),
    ("RobotManage.setOperationalMode", {"mode": "Manual"}, "operational mode is Manual, not Automatic"),
]


@pytest.mark.parametrize(("method", "params", "words"), TAMPERED)
async def test_what_a_press_depends_on_is_read_back_before_each_way_down(
    arm: AuboArcs, other: Controller, cabinet: ArcsServer, method: str, params: dict[str, Any], words: str
):
    await arm.move(ABOVE, **QUICK)
    assert await other.ask(method, **params) == 0
    sent, before = lines(cabinet), cabinet.cabinet.world.tool()
    for refused in (arm.move(LOW, **QUICK), arm.follow([ABOVE, LOW], blend_mm=1.0, **QUICK), arm.take_up()):
        with pytest.raises(SettingsChanged, match=words):
            await refused
    assert lines(cabinet) == sent
    assert cabinet.cabinet.world.tool() == before
    await other.ask("RobotManage.setOperationalMode", mode="Automatic")
    await arm.enable()  # sets what is configured again; what is not is taken as it is
    await arm.move(LOW, **QUICK)
    assert distance(cabinet.cabinet.world.tool(), LOW)[0] < 0.05


async def test_a_safety_stop_is_reported_before_what_it_changes(arm: AuboArcs, other: Controller, cabinet: ArcsServer):
    await arm.move(ABOVE, **QUICK)
    await other.ask("RobotManage.setOperationalMode", mode="Manual")
    cabinet.cabinet.safety_stop()
    with pytest.raises(RobotNotSafe):
        await arm.move(LOW, **QUICK)


async def test_an_arm_without_power_is_not_as_it_was_left_and_enabling_it_powers_it_again(
    arm: AuboArcs, other: Controller
):
    await arm.move(ABOVE, **QUICK)
    await other.ask("RobotManage.poweroff")  # takes a moment, in which a request for power is ignored
    for refused in (arm.confirm(), arm.take_up(), arm.move(LOW, **QUICK)):
        with pytest.raises(NotPowered):
            await refused
    await arm.enable()
    await arm.move(LOW, **QUICK)


@pytest.mark.parametrize("code", [0, 13])
async def test_a_return_code_is_no_proof_that_the_tool_was_set(sleeping_arm: AuboArcs, cabinet: ArcsServer, code: int):
    cabinet._methods["rob1.RobotConfig.setTcpOffset"] = lambda _: code
    with pytest.raises(SettingsChanged, match=r"tool offset is \(0, 0, 0\) mm, .*, not \(0, 0, 180\) mm"):
        await sleeping_arm.enable()
    assert cabinet.cabinet.power.mode == "PowerOff"


@pytest.mark.parametrize(
    ("wanted_deg", "found_deg"),
    [((180.0, 0.0, 0.0), (-180.0, 0.0, 0.0)), ((180.0, 0.0, 30.0), (0.0, 180.0, -150.0))],
)
def test_a_tool_that_is_read_back_in_other_angles_is_the_same_tool(
    wanted_deg: tuple[float, ...], found_deg: tuple[float, ...]
):
    wanted, found = ({TOOL_OFFSET: (0.0, 0.0, 180.0, *turn)} for turn in (wanted_deg, found_deg))
    require_same("enable", wanted, found)


def test_a_tool_turned_by_a_hundredth_of_a_degree_is_another():
    with pytest.raises(SettingsChanged, match=r"\(-179\.99, 0, 0\) deg, not .*\(180, 0, 0\)"):
        require_same("enable", {TOOL_OFFSET: (0, 0, 0, 180, 0, 0)}, {TOOL_OFFSET: (0, 0, 0, -179.99, 0, 0)})


async def test_from_below_the_floor_only_the_tool_axis_leads_up(arm: AuboArcs, other: Controller, cabinet: ArcsServer):
    deep = brush_pose(300.0, -200.0, 80.0, tilt_deg=10.0)
    x_mm = 300.0 + 120.0 * 0.17632698  # tan 10 deg
    await send(other, deep)
    await arm.take_up()
    for wrong in (
        brush_pose(300.0, -200.0, 200.0, tilt_deg=10.0),
        brush_pose(x_mm, -200.0, 200.0),
        brush_pose(450.0, -100.0, 200.0, tilt_deg=10.0),
    ):
        with pytest.raises(LimitExceeded, match=r"the arm stands where z = 80.000 mm is outside \[95"):
            await arm.move(wrong, **QUICK)
    up = brush_pose(x_mm, -200.0, 200.0, tilt_deg=10.0)
    await arm.move(up, **QUICK)
    assert distance(cabinet.cabinet.world.tool(), up)[0] < 0.05


@pytest.mark.parametrize(
    ("stands", "field"),
    [
        (brush_pose(190.0, -200.0, 200.0), "x"),
        (brush_pose(300.0, -270.0, 200.0), "y"),
        (brush_pose(300.0, -200.0, 410.0), "z"),
        (brush_pose(300.0, -200.0, 200.0, tilt_deg=20.0), "tilt"),
        (brush_pose(300.0, -200.0, 80.0, tilt_deg=20.0), "tilt"),
    ],
)
async def test_from_outside_no_line_is_known(arm: AuboArcs, other: Controller, stands: Pose, field: str):
    await send(other, stands)
    await arm.take_up()
    with pytest.raises(LimitExceeded, match=f"the arm stands where {field} = .*Jog the arm up"):
        await arm.move(ABOVE, **QUICK)
