"""Every trap is in the lab as it would be in a real one, and out of it once the person has seen to it."""

from __future__ import annotations

import asyncio
import time

import cv2
import numpy as np
import pytest

from brushloop.drivers.arcs.controller import Controller
from brushloop.drivers.arcs.robot import AUBOPE_PORT
from brushloop.drivers.arcs.wire import RpcConnection, open_arcs
from brushloop.drivers.errors import DeviceTimeout, WrongGeneration
from brushloop.drivers.sim.camera.scene import board
from brushloop.drivers.sim.lab.facts import CORNERS, corner, draw, in_picture
from brushloop.drivers.sim.lab.lab import ARCS_PORT, CAMERA_PORTS, UnknownLab
from brushloop.drivers.sim.lab.traps import Trap, mended, spring

FAST = 500.0
SMALL_PX = (640, 480)


def trapped(seed: int, trap: Trap, picture_px: tuple[int, int] = SMALL_PX) -> UnknownLab:
    return UnknownLab(seed, trap, rate=FAST, picture_px=picture_px)


async def connected(lab: UnknownLab, timeout_s: float = 10.0) -> Controller:
    controller = Controller(RpcConnection(lab.host, ARCS_PORT, timeout_s=timeout_s))
    await open_arcs(controller.connection, AUBOPE_PORT)
    await controller.connection.login()
    [controller.robot, *_] = await controller.robot_names()
    return controller


@pytest.mark.parametrize("trap", Trap)
def test_a_trap_changes_the_lab_and_the_way_out_ends_it(trap: Trap):
    clean = draw(3)
    caught = spring(clean, trap)
    assert caught != clean
    assert spring(clean, trap) == caught
    assert mended(caught, clean, trap) != caught


async def test_swapped_corners_are_taken_for_each_other_until_corrected():
    lab = trapped(4, Trap.SWAPPED_CORNER)
    assert lab.facts.swapped is not None
    asked, went = lab.facts.swapped
    await lab.bring("board-corner", 0, asked)
    there = corner(lab.facts.config.table, "board", went)
    assert lab.world.tool().position_mm == pytest.approx(there, abs=1.0)
    await lab.obey({"act": "mend"})
    await lab.bring("board-corner", 0, asked)
    there = corner(lab.facts.config.table, "board", asked)
    assert lab.world.tool().position_mm == pytest.approx(there, abs=1.0)


async def test_a_mirrored_picture_shows_no_board_until_it_is_turned_round():
    lab = trapped(4, Trap.MIRRORED_CAMERA, (1024, 768))
    await lab.bring("clear-view")
    detector = cv2.aruco.CharucoDetector(board(lab.facts.config.table))

    def seen(picture: np.ndarray) -> int:
        ids = detector.detectBoard(picture)[1]
        return 0 if ids is None else len(ids)

    mirrored = lab.rig.scene.render()
    assert seen(mirrored) < 5 < 60 < seen(np.ascontiguousarray(mirrored[:, ::-1]))
    await lab.obey({"act": "mend"})
    assert seen(lab.rig.scene.render()) > 60


async def test_a_board_printed_to_fit_the_page_is_smaller_than_it_says():
    lab = trapped(4, Trap.WRONG_BOARD_SIZE)
    said_mm, measured_mm = lab.seen().square_mm, float(lab.measure("square"))
    assert measured_mm == pytest.approx(0.97 * said_mm, abs=0.01)
    await lab.obey({"act": "mend"})
    assert lab.seen().square_mm == pytest.approx(measured_mm, abs=0.01)


async def test_a_tool_in_metres_is_a_thousandth_at_the_cabinet_and_on_the_note():
    async with trapped(4, Trap.TCP_IN_METRES) as lab:
        controller = await connected(lab)
        length_mm = lab.facts.config.tool_mm
        assert 1e3 * (await controller.ask("RobotConfig.getTcpOffset"))[2] == pytest.approx(length_mm / 1e3)
        assert float(lab.measure("tool")) == pytest.approx(length_mm / 1e3, abs=1e-3)
        await lab.obey({"act": "mend"})
        assert tuple(await controller.ask("RobotConfig.getTcpOffset")) == draw(4).cabinet_tcp
        assert float(lab.measure("tool")) == pytest.approx(length_mm, abs=1.0)
        await controller.connection.close()


async def test_a_bad_park_is_in_the_picture():
    lab = trapped(4, Trap.PARK_IN_PICTURE)
    await lab.bring("park")
    assert in_picture(lab.facts.config, lab.world.tool().position_mm)
    await lab.obey({"act": "mend"})
    await lab.bring("park")
    assert not in_picture(lab.facts.config, lab.world.tool().position_mm)


async def test_a_slow_camera_sends_its_first_picture_late():
    async with trapped(4, Trap.SLOW_CAMERA) as lab:
        port = CAMERA_PORTS[lab.facts.sheet_camera]
        reader, writer = await asyncio.open_connection(lab.host, port)
        writer.write(b"GET /stream.mjpg HTTP/1.0\r\n\r\n")
        asked_s = time.monotonic()
        await reader.readuntil(b"image/jpeg")
        assert time.monotonic() - asked_s >= 1.2
        writer.close()


async def test_a_sensor_with_the_wrong_sign_is_pulled_where_it_is_pushed():
    lab = trapped(0, Trap.FORCE_SIGN)
    assert lab.rig.force is not None
    lab.world.push_n = (0.0, 0.0, 2.0)
    pushed = lab.world.wrench()[2]
    board_of = lab.rig.force.board
    forces = [board_of._force(0.0)[2]]
    await lab.obey({"act": "mend"})
    forces.append(board_of._force(0.0)[2])
    assert forces == pytest.approx([-pushed, pushed], abs=0.2)


async def test_far_corners_are_out_of_reach_until_the_sheet_is_moved():
    lab = trapped(7, Trap.SHEET_OUT_OF_REACH)
    answers = {name: await lab.bring("board-corner", 0, name) for name in CORNERS}
    missed = [name for name, answer in answers.items() if not answer["reached"]]
    assert missed
    assert "mm before the board-corner" in answers[missed[0]]["says"]
    await lab.obey({"act": "mend"})
    for name in missed:
        assert (await lab.bring("board-corner", 0, name))["reached"]


async def test_the_older_software_answers_on_its_own_port_only():
    async with trapped(4, Trap.OLD_SOFTWARE) as lab:
        with pytest.raises(WrongGeneration, match="8899"):
            await connected(lab)
        assert (await lab.bring("pin"))["reached"]  # the pendant needs no network
        await lab.obey({"act": "mend"})
        controller = await connected(lab)
        await controller.connection.close()


async def test_a_pulled_cable_is_silence_until_it_is_in_again():
    async with trapped(4, Trap.CABLE_PULLED) as lab:
        controller = await connected(lab, timeout_s=0.3)
        assert lab.facts.cable_after is not None
        for index in range(lab.facts.cable_after):
            await controller.joint_positions()
            await lab.bring("pin", index)
        with pytest.raises(DeviceTimeout):
            await controller.joint_positions()
        assert "it is in again" in (await lab.obey({"act": "plug"}))["says"]
        again = await connected(lab)
        await again.joint_positions()
        await again.connection.close()
        await controller.connection.close()
