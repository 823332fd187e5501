"""A lab that nobody has measured: drawn from a seed, the same on the wire as in truth, with a person's hand in it."""

from __future__ import annotations

import json
import math
from collections.abc import AsyncIterator
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.arcs.wire import RpcConnection, open_arcs
from brushloop.drivers.geometry import from_wire, lean
from brushloop.drivers.sim.arm.kinematics import forward, inverted, matrix_of, pose_of
from brushloop.drivers.sim.camera.scene import board
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.lab.facts import CORNERS, corner, draw, in_picture
from brushloop.drivers.sim.lab.lab import ARCS_PORT, UnknownLab
from brushloop.drivers.sim.lab.seen import truth
from brushloop.drivers.sim.rig import _at_sensor
from brushloop.drivers.sim.world import tool_of

SMALL_PX = (640, 480)
FAST = 500.0


def lab_of(seed: int, trap: str | None = None) -> UnknownLab:
    """A lab that does not serve: hand, arm and scene are there, the sockets are not."""
    return UnknownLab(seed, trap, rate=FAST, picture_px=SMALL_PX)  # type: ignore[arg-type]


@pytest.fixture
async def lab() -> AsyncIterator[UnknownLab]:
    async with UnknownLab(4, rate=FAST, picture_px=SMALL_PX) as it:
        yield it


@pytest.fixture
async def controller(lab: UnknownLab) -> AsyncIterator[Controller]:
    asked = Controller(RpcConnection(lab.host, ARCS_PORT, timeout_s=10.0))
    await open_arcs(asked.connection, AUBOPE_PORT)
    await asked.connection.login()
    [asked.robot, *_] = await asked.robot_names()
    yield asked
    await asked.connection.close()


def test_a_seed_is_one_lab_and_the_next_is_another():
    assert draw(5) == draw(5)
    assert draw(5).config.tool_mm != draw(6).config.tool_mm


@pytest.mark.parametrize("seed", range(8))
def test_every_lab_is_one_that_could_be(seed: int):
    facts = draw(seed)
    tool, table = facts.config, facts.config.table
    assert 120.0 <= tool.tool_mm <= 260.0
    assert math.hypot(*tool.tool_sideways_mm) <= 15.0
    assert math.degrees(math.acos(tool_of(tool)[2, 2])) <= 3.0
    assert not in_picture(facts.config, facts.park_mm)
    assert min(table.sheet_mm) > 150.0
    assert max(abs(v) for v in table.slope_deg) <= 1.0


def test_the_known_rig_has_its_tool_and_its_sensor_as_before():
    config = SimConfig()
    wrench = (0.1, -0.2, -1.5, 0.01, 0.02, 0.0)
    assert np.array_equal(tool_of(config), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.18], [0, 0, 0, 1]])
    assert _at_sensor(config, wrench) is wrench


async def test_the_hand_brings_the_true_tip_to_the_thing():
    lab, off_mm = lab_of(4), list[float]()
    for index in range(12):
        await lab.bring("pin", index)
        off_mm += np.subtract(lab.world.tool().position_mm, lab.facts.pin_mm).tolist()
    for name in CORNERS:
        await lab.bring("board-corner", 0, name)
        off_mm += np.subtract(lab.world.tool().position_mm, corner(lab.facts.config.table, "board", name)).tolist()
    assert 0.2 < float(np.std(off_mm)) < 0.4
    assert max(map(abs, off_mm)) < 0.8
    assert lab.world.presses == []


async def test_the_pin_is_met_from_directions_that_tell_the_tool():
    """Least squares over the flange's poses, without the noise of the hand, would find the tool exactly."""
    lab, rows, sides = lab_of(9), list[np.ndarray](), list[np.ndarray]()
    for index in range(8):
        await lab.bring("pin", index)
        flange = forward(lab.cabinet.joints())
        rows.append(np.hstack([flange[:3, :3], -np.eye(3)]))
        sides.append(-flange[:3, 3])
    found, _, rank, singular = np.linalg.lstsq(np.vstack(rows), np.concatenate(sides), rcond=None)
    assert rank == 6
    assert singular[0] / singular[-1] < 8.0
    assert 1e3 * found[:3] == pytest.approx(truth(lab.facts, None)["tool"]["tcp_offset_mm"], abs=0.6)


async def test_upright_by_a_set_square_gives_the_brushs_axis():
    lab, axes = lab_of(3), list[np.ndarray]()
    for index in range(4):
        await lab.bring("upright", index)
        assert lean(lab.world.tool())[0] < 0.6
        axes.append(forward(lab.cabinet.joints())[:3, :3].T @ [0.0, 0.0, -1.0])
    assert np.mean(axes, axis=0) == pytest.approx(truth(lab.facts, None)["tool"]["brush_axis"], abs=math.radians(0.3))


async def test_what_a_client_reads_agrees_with_the_truth(lab: UnknownLab, controller: Controller):
    await lab.bring("pin", 2)
    joints = await controller.joint_positions()
    tcp = from_wire(await controller.ask("RobotConfig.getTcpOffset"))
    reported = await controller.pose()
    assert [*map(float, matrix_of(tcp)[:3, 3])] == pytest.approx(list(lab.facts.cabinet_tcp[:3]))
    assert pose_of(forward(joints) @ matrix_of(tcp)).position_mm == pytest.approx(reported.position_mm, abs=1e-3)
    flange = matrix_of(reported) @ inverted(matrix_of(tcp))
    tip = pose_of(flange @ tool_of(lab.facts.config))
    assert tip.position_mm == pytest.approx(lab.world.tool().position_mm, abs=1e-3)
    assert (await controller.ask("RobotConfig.getPayload"))[0] == lab.facts.payload_kg
    assert await controller.ask("RobotState.isSteady")


async def test_the_camera_shows_the_arm_where_it_was_guided(lab: UnknownLab):
    scene = lab.rig.scene
    await lab.bring("clear-view")
    empty = scene.render().astype(int)
    await lab.bring("sheet-corner", 0, "lower left")
    assert (np.abs(scene.render().astype(int) - empty) > 40).mean() > 0.02
    await lab.bring("park")
    assert (np.abs(scene.render().astype(int) - empty) > 40).mean() < 0.001


async def test_the_other_stream_shows_the_arm_and_no_board(lab: UnknownLab):
    room = lab._room._scene
    room.tool()
    before = room.render().astype(int)
    await lab.bring("well")
    room.tool()
    after = room.render()
    assert (np.abs(after.astype(int) - before) > 40).mean() > 0.003
    _, ids, _, _ = cv2.aruco.CharucoDetector(board(lab.facts.config.table)).detectBoard(after)
    assert ids is None


async def test_a_held_board_is_seen_slanted_and_gives_the_lens():
    lab, objects, images = UnknownLab(4, rate=FAST, picture_px=(1280, 960)), [], []
    made = board(lab.facts.config.table)
    detector = cv2.aruco.CharucoDetector(made)
    for index in range(6):
        await lab.bring("hold-board", index)
        picture = lab.rig.scene.render()
        corners, ids, _, _ = detector.detectBoard(picture)
        assert len(ids) > 60
        on_board, in_image = made.matchImagePoints(corners, ids)
        objects.append(on_board)
        images.append(in_image)
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    rms_px, matrix, distortion, _, _ = cv2.calibrateCamera(objects, images, (1280, 960), np.eye(3), None, flags=flags)
    known = truth(lab.facts, None)["camera"]
    assert rms_px < 0.4
    assert matrix[0, 0] == pytest.approx(known["matrix"][0][0], rel=0.02)
    assert float(np.ravel(distortion)[0]) == pytest.approx(known["k1"], abs=0.02)
    await lab.bring("clear-view")
    assert lab.rig.scene.held is None


def test_a_push_is_felt_in_the_sensors_axes():
    facts = draw(2)
    config = replace(facts.config, sensor_turn_deg=90.0, sensor_sign=1, tool_lean_deg=(0.0, 0.0))
    fx, fy, fz, *_ = _at_sensor(config, (2.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert (fx, fy, fz) == pytest.approx((0.0, -2.0, 1.0))
    fx, fy, fz, *_ = _at_sensor(replace(config, sensor_sign=-1), (2.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert (fx, fy, fz) == pytest.approx((0.0, 2.0, -1.0))


async def test_a_finger_pushes_for_a_second(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("brushloop.drivers.sim.lab.hand.PUSH_S", 0.0)
    lab, felt = lab_of(2), list[tuple[float, ...]]()
    before = np.array(lab.world.wrench()[:3])
    monkeypatch.setattr("asyncio.sleep", lambda _s: _now(felt, lab))
    await lab.bring("push-sensor", 0)
    upright = Rotation.from_quat(lab.world.tool().quaternion)
    assert upright.apply(np.array(felt[0]) - before) == pytest.approx([0.0, 0.0, 2.0], abs=1e-6)
    assert lab.world.wrench()[:3] == pytest.approx(before)


async def _now(felt: list[tuple[float, ...]], lab: UnknownLab) -> None:
    felt.append(lab.world.wrench()[:3])


def test_what_is_seen_names_no_truth(lab: UnknownLab):
    words = " ".join(lab.seen().lines())
    assert lab.host in words
    for hidden in (lab.facts.config.tool_mm, lab.facts.config.table.yaw_deg, lab.facts.pin_mm[0]):
        assert f"{hidden:.1f}" not in words


def test_the_truth_is_json_with_what_a_first_day_finds():
    known = json.loads(json.dumps(truth(draw(1), None)))
    assert {"tool", "paper", "board", "well", "park_mm", "camera", "force"} <= set(known)


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"act": "dance"}, "act = 'dance' is not one of bring"),
        ({"act": "bring", "to": "moon"}, "to = 'moon' is not one of pin"),
        ({"act": "bring", "to": "pin", "index": -1}, "index = -1"),
        ({"act": "bring", "to": "pin", "index": True}, "index = True"),
        ({"act": "bring", "to": "board-corner", "corner": "middle"}, "corner = 'middle' is not one of lower left"),
        ({"act": "measure", "to": "weight"}, "to = 'weight' is not one of square"),
    ],
)
async def test_what_a_person_cannot_do_is_named(request_: dict[str, object], words: str):
    with pytest.raises(ValueError, match=words):
        await lab_of(4).obey(request_)
