"""Bring the tip to a place: by hand or by jog, in small steps by key, each checked against the box known so far."""

from __future__ import annotations

import contextlib
import math
from collections.abc import AsyncGenerator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.collect.errors import CannotTeach
from brushloop.collect.rig.devices import sole_driver
from brushloop.collect.teach.arm import ArmReader, taught_arm, tip_of
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.guide import Brought, JogStep, JogView, Question, Target, TargetKind, WentBack
from brushloop.collect.teach.store import Notebook, touch_of
from brushloop.drivers.arcs.robot import ArcsOptions, AuboArcs
from brushloop.drivers.devices import Pose, Robot
from brushloop.drivers.errors import LimitExceeded
from brushloop.drivers.geometry import lean
from brushloop.drivers.limits import Limits

STEPS_MM = (0.1, 0.5, 2.0, 5.0)
SPEED_MM_S, ACC_MM_S2 = 20.0, 200.0
MOST_MM_S = 50.0
"""The driver refuses anything faster."""
ROOM_MM, BELOW_MM = 25.0, 5.0
"""Room around what is known to be free: beside and above it, and below its lowest place."""
LEAST_CONE_DEG, CONE_ROOM_DEG = 15.0, 1.0
Tool = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Flange to tip: the offset in mm, and the turn about x, y and z of the flange in deg."""
JOGGED: frozenset[TargetKind] = frozenset(
    {"pin", "board-corner", "sheet-corner", "well", "well-rim", "wash-pot", "wash-rim", "park"}
)
"""Places to which the last millimetres may be jogged."""


async def touch(
    day: Day, reader: ArmReader, target: Target, how: str, name: str, *, may_skip: bool = False
) -> Pose | None:
    """Ask for the tip to be brought to a thing, and note the flange's pose there; None if the person skips it.

    A thing that was touched before is not asked for again. The person may jog to it where the arm is armed.
    """
    if name in day.notebook.touches:
        return day.notebook.touches[name].pose()
    may_jog = day.armed and target.kind in JOGGED
    question = Question("bring", how, target=target, may_jog=may_jog, may_skip=may_skip)
    while (brought := await day.ask(question)) is Brought.JOG:
        if not may_jog:
            await day.say("Nothing is moved without --arm: guide the arm by hand.", tone="warning")
        elif await jogged(day, how):
            break
    if brought is Brought.SKIP:
        return None
    flange = await reader.flange()
    day.save(day.notebook.with_touch(name, touch_of(flange)))
    return flange


async def jogged(day: Day, what: str) -> bool:
    """Let the person jog until the tip is there; False where the person goes back to the hand.

    Asks for the key that lets the arm move. Raises `ConfigError`, and `DeviceError` where the arm cannot make a step
    that the box allows.
    """
    try:
        await day.may_move(f"Jog in steps of at most {STEPS_MM[-1]:g} mm, at {SPEED_MM_S:g} mm/s")
    except (CannotTeach, WentBack):
        return False
    await day.working("powering the arm")
    async with _enabled(day) as robot:
        began, refused = await robot.where(), ""
        while True:
            here = await robot.where()
            x, y, z = (now - then for now, then in zip(here.position_mm, began.position_mm, strict=True))
            try:
                answer = await day.guide.ask(Question("jog", what, jog=JogView((x, y, z), STEPS_MM, refused)))
            except WentBack:
                return False
            if not isinstance(answer, JogStep):
                return True
            refused = await _step(robot, answer)


async def _step(robot: Robot, step: JogStep) -> str:
    """Make one step, or return why it is not made."""
    if not any(math.isclose(abs(step.mm), size) for size in STEPS_MM):
        return f"{step.mm:g} mm is not one of the steps"
    here = await robot.take_up()
    x, y, z = (v + step.mm * (name == step.axis) for name, v in zip("xyz", here.position_mm, strict=True))
    try:
        await robot.move(replace(here, x_mm=x, y_mm=y, z_mm=z), speed_mm_s=SPEED_MM_S, acc_mm_s2=ACC_MM_S2)
    except LimitExceeded as error:
        return f"not made: {error.what}. Guide the arm by hand to go farther"
    return ""


@contextlib.asynccontextmanager
async def _enabled(day: Day) -> AsyncGenerator[Robot]:
    """The arm, powered, with its limits around what is known; stopped and left where it is at the end."""
    book = day.notebook
    host, port = str(book.get("robot.host")), int(book.number("robot.port"))
    async with taught_arm(book) as reader:
        flange, cabinet = await reader.flange(), await reader.tool()
    x, y, z, rx, ry, rz = cabinet
    tool: Tool = (1e3 * x, 1e3 * y, 1e3 * z), (math.degrees(rx), math.degrees(ry), math.degrees(rz))
    if "robot.tcp_offset_mm" in book.values:
        (x, y, z), (rx, ry, rz) = book.numbers("robot.tcp_offset_mm"), book.numbers("robot.tcp_rotation_deg")
        tool = (x, y, z), (rx, ry, rz)
    options = ArcsOptions(host, port, *tool, framing=book.framing)
    robot = AuboArcs(options, limits_so_far(book, flange, tool), day.clock)
    with sole_driver(host, port):
        try:
            await robot.connect()
            await robot.enable()
            await robot.take_up()
            yield robot
        finally:
            await robot.close()


def limits_so_far(book: Notebook, flange: Pose, tool: Tool) -> Limits:
    """The smallest box around everything touched and where the hand has left the arm now, with some room.

    The cone is as wide as the brush leans now: a jog does not turn the brush.
    """
    offset_mm, turn_deg = tool
    here_mm = tip_of(flange, offset_mm)
    touched = [tip_of(touch.pose(), offset_mm) for touch in book.touches.values()]
    x_mm, y_mm, (low_mm, high_mm) = hull([here_mm, *touched], ROOM_MM)
    turn = Rotation.from_quat(flange.quaternion) * Rotation.from_euler("ZYX", turn_deg[::-1], degrees=True)
    qx, qy, qz, qw = (float(v) for v in turn.as_quat())
    cone_deg = max(lean(Pose(*here_mm, qx, qy, qz, qw))[0] + CONE_ROOM_DEG, LEAST_CONE_DEG)
    return Limits(x_mm, y_mm, (low_mm - BELOW_MM, high_mm), cone_deg, MOST_MM_S, ACC_MM_S2)


Point = tuple[float, float, float]


def hull(
    points: Sequence[Point], margin_mm: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Ranges of x, y and z around these points, widened by the margin in x and y, and upward in z; rounded outward."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    return (
        (math.floor(low[0] - margin_mm), math.ceil(high[0] + margin_mm)),
        (math.floor(low[1] - margin_mm), math.ceil(high[1] + margin_mm)),
        (math.floor(10.0 * low[2]) / 10.0, math.ceil(high[2] + margin_mm)),
    )
