"""Before real hardware moves, somebody says that it may."""

from __future__ import annotations

from collect.errors import CollectAborted, ConfigError
from collect.operator import Asker, Choice, Prompt
from collect.rig.devices import Rig

ARM, LEAVE = Choice("a", "arm it: I look at the cell, my hand is at the emergency stop"), Choice("x", "leave it")


async def arm(rig: Rig, asker: Asker, *, armed: bool) -> None:
    """Pass for the loopback rig, and where `armed` was said on the command line; else ask, naming robot and address.

    Raises `ConfigError` where nobody can be asked, `CollectAborted` for a no. Nothing was powered and nothing moved.
    """
    if armed or rig.robot_identity.simulated:
        return
    robot = rig.config.robot
    what = f"{rig.robot_identity.model} at {robot.host}:{robot.port} is real hardware"
    if not asker.watched:
        raise ConfigError(
            "rig.toml", "robot", f"{what}: look at the cell, keep a hand at the emergency stop, then add --arm"
        )
    if await asker.ask(Prompt(f"{what}. May it move?", (ARM, LEAVE), LEAVE.key)) != ARM.key:
        raise CollectAborted("not armed; nothing was powered and nothing moved")
