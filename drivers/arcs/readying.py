"""What is checked and set before an arm is powered, and powering it: each step may refuse, none moves or clears."""

from __future__ import annotations

from collections.abc import Callable

from drivers.arcs.codes import RobotMode
from drivers.arcs.controller import Controller, accepted
from drivers.arcs.errors import WrongOperationalMode
from drivers.arcs.options import ArcsOptions
from drivers.arcs.rpc import DEVICE
from drivers.arcs.settings import OPERATIONAL_MODE, Settings, Value, configured, read_back, require_same
from drivers.arcs.waiting import until_mode


async def make_ready(controller: Controller, options: ArcsOptions, on_notice: Callable[[str], None]) -> Settings:
    """Check the operational mode, then set tool, payload, collision level and speed, where configured, and read all
    back: a return code is no proof, least of all `ignored`.

    Raises `WrongOperationalMode`, `MotionRefused` for what the controller does not take, and `SettingsChanged` for what
    it says that it took and has not.
    """
    _require_automatic((await read_back(controller))[OPERATIONAL_MODE], on_notice)
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
    found = await read_back(controller)
    require_same("power on", configured(options), found)
    for name in (name for name, value in found.items() if value is None and name != OPERATIONAL_MODE):
        on_notice(f"the controller does not tell its {name}: whether it changes cannot be seen")
    return found


async def power_on(controller: Controller, options: ArcsOptions) -> None:
    """Power the arm and release its brakes, where that was not done. Raises `RobotNotSafe`, `DeviceTimeout`."""

    async def until(*wanted: RobotMode) -> None:
        await until_mode(controller, {*wanted}, timeout_s=options.power_timeout_s, poll_s=options.poll_s)

    await controller.require_safe("power on")
    if await controller.mode() != RobotMode.RUNNING:
        await controller.ask("RobotManage.poweron")
        await until(RobotMode.IDLE, RobotMode.RUNNING)
        await controller.ask("RobotManage.startup")
        await until(RobotMode.RUNNING)


def _require_automatic(mode: Value, on_notice: Callable[[str], None]) -> None:
    """Manual, or a word that is none, is for a person beside the arm."""
    if mode is None:
        on_notice("the controller has no operational mode to check")
    elif mode == "Disabled":
        on_notice("operational modes are disabled on this cabinet")
    elif mode != "Automatic":
        raise WrongOperationalMode(DEVICE, "power on", str(mode))
