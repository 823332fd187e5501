"""The arm that the contract is held against: the loopback controller, or the arm of `--rig rig.toml`.

python -m pytest tests/contract                    the loopback controller, in both framings
python -m pytest tests/contract --rig rig.toml     a real arm; asks before it moves
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from brushloop.collect.errors import ConfigError
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import limits_of, make_robot, sole_driver
from brushloop.drivers.arcs.robot import AuboArcs
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceError, LimitExceeded
from brushloop.drivers.geometry import distance
from brushloop.drivers.host import HostClock
from brushloop.drivers.sim.arcs_server import ArcsServer, RtdeServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import HOST, rig_toml
from brushloop.drivers.sim.world import SimClock, World
from tests.contract.asking import ACC_MM_S2, LIFT_MM, SAME_PLACE_MM, SPEED_MM_S, Enabled, permission_refused, raised
from tests.simulated_time import SimulatedTimeLoop

RATE = 5.0
LOOPBACK = ("sof", "bare", "sof, RTDE")
RIG = pytest.StashKey[RigConfig]()
BEGAN = pytest.StashKey[Pose]()


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
    return {"real": asyncio.new_event_loop} if RIG in config.stash else {"simulated": SimulatedTimeLoop}


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
    config = SimConfig(rate=RATE, force_sensor=False, ink_device="none")
    server = ArcsServer(World(config, SimClock(RATE, asyncio.get_running_loop().time)))
    await server.start(HOST, 0)
    pushing = RtdeServer(server)
    await pushing.start(HOST, 0)
    try:
        path = request.getfixturevalue("tmp_path") / "rig.toml"
        path.write_text(rig_toml(config, ports={"arcs": server.port, "rtde": pushing.port}), encoding="utf-8")
        loopback = load_rig(path)
        how = {"framing": framing, "rtde_port": pushing.port if rtde else None}
        yield loopback.model_copy(update={"robot": loopback.robot.model_copy(update=how)})
    finally:
        await pushing.stop()
        await server.stop()


@pytest.fixture
def the_only_driver(rig: RigConfig) -> Iterator[None]:
    with sole_driver(rig.robot.host, rig.robot.port):
        yield


@pytest.fixture
async def arm(rig: RigConfig, the_only_driver: None) -> AsyncIterator[AuboArcs]:
    """Connected; nothing was powered from here."""
    robot = make_robot(rig, HostClock(), print)
    await robot.connect()
    yield robot
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
    await arm.move(start, speed_mm_s=SPEED_MM_S, acc_mm_s2=ACC_MM_S2)
