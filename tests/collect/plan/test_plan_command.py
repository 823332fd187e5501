"""`brushloop collect plan`: tables, a picture, the controller's word on reach; and `collect` as it was."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from brushloop.calibrate.errors import CalibrationError
from brushloop.collect.cli import app
from brushloop.collect.errors import ConfigError
from brushloop.collect.plan import draw_plan, make_plan
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.walk import all_poses, ask_reach, check_protocol
from brushloop.drivers.arcs.controller import RobotMode
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import rig_toml
from brushloop.drivers.sim.world import World

EXAMPLES = Path(__file__).parents[3] / "examples"
HERE = "127.0.0.1"


@pytest.fixture
def rig_path(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(rig_toml(SimConfig()))
    return path


@pytest.fixture
async def cabinet() -> AsyncIterator[ArcsServer]:
    server = ArcsServer(World(SimConfig(rate=20.0)))
    await server.start(HERE, 0)
    yield server
    await server.stop()


def at(rig_path: Path, port: int) -> RigConfig:
    rig_path.write_text(rig_path.read_text().replace("port = 30004\n", f"port = {port}\n"))
    return load_rig(rig_path)


def plan(rig_path: Path, name: str, *options: str) -> str:
    arguments = ["plan", "--config", str(rig_path), "--protocol", str(EXAMPLES / name), *options]
    ran = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert ran.exit_code == 0
    return ran.stdout


def test_a_plan_is_shown_as_tables(rig_path: Path) -> None:
    words = " ".join(plan(rig_path, "protocol.toml").split())
    for expected in ("4 of 42 patches", "a fresh one before", "150 press", "not counting"):
        assert expected in words


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.toml")))
def test_every_example_passes_and_has_a_picture_whatever_its_names(rig_path: Path, tmp_path: Path, name: str) -> None:
    path, config = tmp_path / "plan.png", load_rig(rig_path)
    for each in EXAMPLES.glob("*.csv"):
        (tmp_path / each.name).write_bytes(each.read_bytes())
    # No font here has that character, and a dollar would begin a formula.
    (tmp_path / name).write_text((EXAMPLES / name).read_text().replace('"shi"', '"永$x"'))
    wanted = load_protocol(tmp_path / name)
    check_protocol(rig_path, tmp_path / name, config, wanted)
    plan = make_plan(config, wanted)
    assert plan.seconds > 10.0
    draw_plan(config, wanted, plan, path)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert min(image.shape) > 400
    assert image.std() > 10.0


def test_a_picture_that_cannot_be_made_is_refused_before_anything_else(rig_path: Path) -> None:
    rig_path.write_text("[robot")  # is not even read
    with pytest.raises(CalibrationError, match=r"plan\.xyz: must end in \.png or \.svg or \.pdf or \.jpg$") as refused:
        plan(rig_path, "protocol.toml", "--picture", str(rig_path.with_name("plan.xyz")))
    assert refused.value.exit_code == 2


async def test_the_controller_is_asked_for_every_pose_and_nothing_is_powered_set_or_moved(
    rig_path: Path, cabinet: ArcsServer
) -> None:
    config, asked = at(rig_path, cabinet.port), list[str]()
    cabinet.cabinet.tcp_offset = [0.01, 0.0, 0.05, 0.0, 0.0, 0.4]  # another tool than ours is set there
    for name, method in list(cabinet._methods.items()):
        cabinet._methods[name] = lambda p, name=name, method=method: (asked.append(name), method(p))[1]
    wanted = load_protocol(EXAMPLES / "protocol-write.toml")
    count = await ask_reach(rig_path, config, all_poses(config, wanted, PaperPlane(120.0)))
    assert count > 40
    names = {name.split(".")[-1] for name in asked}
    assert names == {"getRobotNames", "getTcpOffset", "getJointPositions", "inverseKinematics"}
    assert cabinet.cabinet.power.mode == RobotMode.POWER_OFF
    assert cabinet.cabinet.tcp_offset[0] == 0.01


async def test_the_first_pose_out_of_reach_of_our_tool_is_named_whatever_is_set_on_the_controller(
    rig_path: Path, cabinet: ArcsServer
) -> None:
    """The same pose is as far away with either tool set; only a wrong conversion would bring it into reach."""
    config, refused = at(rig_path, cabinet.port), list[str]()
    for offset in ([0.0] * 6, [0.0, 0.0, 0.18, 0.0, 0.0, 0.0], [0.05, -0.1, 0.3, 0.0, 0.0, 1.0]):
        cabinet.cabinet.tcp_offset = offset
        row = [(brush_pose(x_mm, 0.0, 200.0), 10.0, f"{x_mm:.0f}") for x_mm in range(700, 1200, 20)]
        with pytest.raises(ConfigError, match=r"paper: .* no joint solution for (\d+): x = \1") as caught:
            await ask_reach(rig_path, config, row)
        refused.append(str(caught.value))
    assert refused == [refused[0]] * 3


async def test_a_tool_that_is_no_number_is_an_error_of_the_device(rig_path: Path, cabinet: ArcsServer) -> None:
    config = at(rig_path, cabinet.port)
    cabinet._methods["rob1.RobotConfig.getTcpOffset"] = lambda _: [math.nan] * 6
    with pytest.raises(ProtocolViolation, match="getTcpOffset: expected 6 finite numbers"):
        await ask_reach(rig_path, config, [(brush_pose(300.0, 0.0, 200.0), 10.0, "park")])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "rig.toml: no such file: `brushloop rig new`"),
        (("--config", "p.toml"), "p.toml: is a protocol, not a rig: give it to --protocol"),
        (("--config", "r.toml", "--protocol", "r.toml"), "r.toml: is a rig, not a protocol: give it to --config"),
        (("--config", "r.toml"), "protocol.toml: no such file: choose another one"),
    ],
)
@pytest.mark.parametrize("command", ["strokes", "plan"])
def test_files_that_are_missing_or_swapped_are_named(
    rig_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, arguments: tuple[str, ...], words: str
) -> None:
    rig_path.rename(rig_path.with_name("r.toml"))
    rig_path.with_name("p.toml").write_text((EXAMPLES / "protocol.toml").read_text())
    monkeypatch.chdir(rig_path.parent)
    with pytest.raises(ConfigError) as refused:
        CliRunner().invoke(app, [command, *arguments], catch_exceptions=False)
    assert str(refused.value).startswith(words)
