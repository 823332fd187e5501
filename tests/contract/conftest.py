"""The arm that the contract is held against: the loopback controller, or the arm of `--rig rig.toml`.

An arm goes a few millimetres straight up, slowly, and back; a real one only after a yes.

python -m pytest tests/contract                    the loopback controller, in both framings
python -m pytest tests/contract --rig rig.toml     a real arm; asks before it moves
"""

from __future__ import annotations

import asyncio
import dataclasses
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import limits_of, make_robot, sole_driver
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Identity, Pose
from brushloop.drivers.errors import DeviceError, LimitExceeded
from brushloop.drivers.geometry import distance
from brushloop.drivers.host import Clock
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig
from brushloop.drivers.sim.world import SimClock
from tests.simulated_time import MemoryLoop

RATE = 5.0
LOOPBACK = ("bare", "sof, RTDE")
"""Both framings, and both ways of telemetry: polled and pushed."""
RIG = pytest.StashKey[RigConfig]()
BEGAN = pytest.StashKey[Pose]()
LIFT_MM = 5.0
"""No test sends the tip higher than this above where it stood, lower than that, or sideways."""
SPEED_MM_S = 10.0
SLOW_MM_S = 2.0
"""For a move that is stopped on its way."""
ACC_MM_S2 = 100.0
SAME_PLACE_MM = 0.5
"""Somebody moved the arm between two tests where it stands farther than this from where the first began."""


@dataclasses.dataclass(frozen=True, slots=True)
class Enabled:
    """An arm that may move, where it stands, and the highest pose that a test may send it to."""

    robot: AuboArcs
    start: Pose
    top: Pose


def raised(pose: Pose, by_mm: float) -> Pose:
    """The same attitude, straight above."""
    return dataclasses.replace(pose, z_mm=pose.z_mm + by_mm)


QUESTION = "Keep a hand at the emergency stop. May the arm move? [y/N] "


def permission_refused(config: pytest.Config, rig: RigConfig, tests: int) -> str | None:
    """Tell and ask; None for a yes, else why no test may move the arm. Raises what connecting raises."""
    with sole_driver(rig.robot.host, rig.robot.port):
        identity, where, state = asyncio.run(_look(rig))
    capture = config.pluginmanager.getplugin("capturemanager")
    assert capture is not None
    capture.suspend_global_capture(in_=True)
    try:
        sys.stdout.write(_announcement(rig, identity, where, state, tests))
        if not sys.stdin.isatty():
            sys.stdout.write("No terminal to ask on: nothing moves.\n")
            return "--rig: no terminal to ask on whether the arm may move"
        sys.stdout.write(QUESTION)
        sys.stdout.flush()
        answer = sys.stdin.readline().strip().lower()
    finally:
        # Back to how pytest has it while it collects: output goes through, input is cut off.
        capture.resume_global_capture()
        capture.suspend_global_capture(in_=False)
    return None if answer in ("y", "yes") else f"--rig: the answer to whether the arm may move was {answer or 'no'!r}"


async def _look(rig: RigConfig) -> tuple[Identity, Pose, tuple[str, str]]:
    """Connect and ask; powers, sets and moves nothing."""
    robot = make_robot(rig, Clock(), lambda _text: None)
    try:
        return await robot.connect(), await robot.where(), await robot.modes()
    finally:
        await robot.close()


def _announcement(rig: RigConfig, identity: Identity, where: Pose, modes: tuple[str, str], tests: int) -> str:
    robot, limits = rig.robot, rig.robot.limits
    what = "the loopback rig, simulated" if identity.simulated else "A REAL ARM"
    x, y, z = where.position_mm
    return f"""
{tests} tests are about to power an arm and move it.
  robot    {identity.model}, {identity.firmware}: {what}
  address  {robot.host}:{robot.port}, framing {robot.framing}; rig {rig.name!r}
  state    robot mode {modes[0]}, safety mode {modes[1]}
  tip      x {x:.1f}, y {y:.1f}, z {z:.1f} mm with the tool that the controller has now; the rig's tool is set first
  box      straight up by at most {LIFT_MM:g} mm from where the tip stands, and back; not lower, not sideways, no turn
  step     {LIFT_MM:g} mm at most, at {SPEED_MM_S:g} mm/s and {ACC_MM_S2:g} mm/s2 at most
  limits   z {limits.z_mm[0]:g} to {limits.z_mm[1]:g} mm with that tool; the driver checks each target before it is sent
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--rig", type=Path, metavar="RIG_TOML", help="hold the contract against the arm of this rig.toml")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "moves: powers the arm and may move it; with --rig only after a yes")
    path = config.getoption("--rig", None)
    if path is None:
        return
    if getattr(config.option, "numprocesses", None) or hasattr(config, "workerinput"):
        raise pytest.UsageError("--rig: one arm cannot be driven by several processes; leave -n out")
    try:
        config.stash[RIG] = load_rig(path)
    except ConfigError as error:
        raise pytest.UsageError(f"--rig: {error}") from None


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """The test of the flag itself brings its own rig, and must not run inside a run on an arm."""
    return True if RIG in config.stash and collection_path.name == "test_rig_option.py" else None


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "rig" in metafunc.fixturenames:
        metafunc.parametrize("rig", ["rig.toml"] if RIG in metafunc.config.stash else LOOPBACK, indirect=True)


def pytest_asyncio_loop_factories(config: pytest.Config) -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Nobody waits for the loopback controller: its time is simulated."""
    return {"real": asyncio.new_event_loop} if RIG in config.stash else {"simulated": MemoryLoop}


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Ask once, before the first test, and only where one that moves was selected."""
    moving = [item for item in items if item.get_closest_marker("moves")]
    if RIG not in config.stash or not moving or config.option.collectonly:
        return
    try:
        refused = permission_refused(config, config.stash[RIG], len(moving))
    except (ConfigError, DeviceError) as error:
        pytest.exit(str(error), returncode=2)
    if refused is not None:
        for item in moving:
            item.add_marker(pytest.mark.skip(reason=refused))


@pytest.fixture
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[RigConfig]:
    """Where the arm is: the one of `--rig`, or a loopback controller of this test's own."""
    if RIG in request.config.stash:
        yield request.config.stash[RIG]
        return
    framing, _, rtde = request.param.partition(", ")
    rig = LoopbackRig(SimConfig(rate=RATE, force_sensor=False, ink_device="none"))
    rig.world.clock = SimClock(RATE, asyncio.get_running_loop().time)
    async with rig:
        path = request.getfixturevalue("tmp_path") / "rig.toml"
        path.write_text(rig.toml(), encoding="utf-8")
        loopback = load_rig(path)
        how = {"framing": framing, "rtde_port": rig.rtde.port if rtde else None}
        yield loopback.model_copy(update={"robot": loopback.robot.model_copy(update=how)})


@pytest.fixture
def the_only_driver(rig: RigConfig) -> Iterator[None]:
    with sole_driver(rig.robot.host, rig.robot.port):
        yield


@pytest.fixture
async def arm(rig: RigConfig, the_only_driver: None) -> AsyncIterator[AuboArcs]:
    """Connected; nothing was powered from here."""
    robot = make_robot(rig, Clock(), print)
    try:
        await robot.connect()
        yield robot
    finally:
        await robot.close()


@pytest.fixture
async def enabled(rig: RigConfig, arm: AuboArcs, request: pytest.FixtureRequest) -> AsyncIterator[Enabled]:
    """Powered, within its limits, where every test began; moved back there in the end, whatever happened."""
    await arm.enable()
    start = await arm.where()
    if RIG in request.config.stash:
        began = request.config.stash.setdefault(BEGAN, start)
        if distance(start, began)[0] > SAME_PLACE_MM:
            pytest.exit(f"the arm is {distance(start, began)[0]:.1f} mm from where it was at the first test", 4)
    top = raised(start, LIFT_MM)
    try:
        limits_of(rig).check_start("robot", start)
        limits_of(rig).check("robot", top, speed_mm_s=SPEED_MM_S, acc_mm_s2=ACC_MM_S2)
    except LimitExceeded as error:
        pytest.skip(f"no room to move: {error}")
    yield Enabled(arm, start, top)
    await arm.follow([start], speed_mm_s=SPEED_MM_S, acc_mm_s2=ACC_MM_S2)
