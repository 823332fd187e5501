"""What is checked and set before an arm is powered: each step may refuse, none moves or clears anything."""

from __future__ import annotations

from collections.abc import Callable

from drivers.arcs.controller import Controller, accepted
from drivers.arcs.errors import WrongOperationalMode
from drivers.arcs.options import ArcsOptions
from drivers.arcs.rpc import DEVICE
from drivers.errors import RpcError

METHOD_NOT_FOUND = -32601


async def make_ready(controller: Controller, options: ArcsOptions, on_notice: Callable[[str], None]) -> None:
    """Check the operational mode and safety, then set tool, payload, collision level and speed, where configured.

    Raises `WrongOperationalMode`, `RobotNotSafe`, or `MotionRefused` for what the controller does not take.
    """
    await _require_automatic(controller, on_notice)
    await controller.set_tcp_offset(options.tcp_offset_mm)
    if options.payload_kg is not None:
        params = {
            "m": options.payload_kg,
            "cog": [v / 1e3 for v in options.payload_cog_mm],
            "aom": [0.0] * 3,
            "inertia": [0.0] * 6,
        }
        accepted("setPayload", await controller.ask("RobotConfig.setPayload", **params))
    if options.collision_level is not None:
        code = await controller.ask("RobotConfig.setCollisionLevel", level=options.collision_level)
        accepted("setCollisionLevel", code)
    if options.speed_fraction is not None:
        code = await controller.ask("MotionControl.setSpeedFraction", fraction=options.speed_fraction)
        accepted("setSpeedFraction", code)


async def _require_automatic(controller: Controller, on_notice: Callable[[str], None]) -> None:
    """Manual, or a word that is none, is for a person beside the arm."""
    try:
        mode = str(await controller.ask("RobotManage.getOperationalMode"))
    except RpcError as error:
        if error.code != METHOD_NOT_FOUND:
            raise
        on_notice("the controller has no operational mode to check")
        return
    if mode == "Disabled":
        on_notice("operational modes are disabled on this cabinet")
    elif mode != "Automatic":
        raise WrongOperationalMode(DEVICE, "power on", mode)
