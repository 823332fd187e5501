"""A process that presses for ever, with only an arm: `python -m tests.collect.durability.pressing RIG_TOML SEED`."""

from __future__ import annotations

import asyncio
import itertools
import random
import sys
from pathlib import Path
from typing import Any, cast

from brushloop.collect.motion import Procedures
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.devices import Rig, make_robot
from brushloop.collect.rig.paper import Sheet
from brushloop.drivers.host import HostClock
from brushloop.sessions.records import Condition


async def press_for_ever(path: Path, seed: int) -> None:
    """Say when the first press begins."""
    rng, config, clock = random.Random(seed), load_rig(path), HostClock()
    robot = make_robot(config, clock, lambda _text: None)
    nothing = cast(Any, None)
    identity = await robot.connect()
    procedures = Procedures(Rig(config, clock, robot, nothing, identity, nothing))
    await robot.enable()
    await procedures.retreat()
    sys.stdout.write("pressing\n")
    sys.stdout.flush()
    sheet = Sheet(config.paper)
    for number in itertools.count():
        patch = sheet.patch(number % sheet.capacity)
        await procedures.press(
            patch, Condition(rng.uniform(5.0, 20.0), rng.uniform(0.0, 14.0)), rng.choice([0.0, 0.2, 0.5])
        )


if __name__ == "__main__":
    asyncio.run(press_for_ever(Path(sys.argv[1]), int(sys.argv[2])))
