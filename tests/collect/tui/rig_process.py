"""`python -m tests.collect.tui.rig_process FILE RATE`: a loopback rig beside the app, not in its process.

Nothing splits by itself. Each line on its input is done and answered: `split` (the next press does), `stop` (a
protective stop), `release` (a person at the pendant), `tool` (where the tip is).
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from bench.harness import lines_of_input, tell
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.sim.brush.footprint import Flaw
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.rig import LoopbackRig

MOST_PRESSES = 100
VIEW = View(width_px=1024, height_px=768, px_per_mm=3.125, fps=5.0)
"""Half as sharp as the camera is by default: sharp enough to judge by."""


async def serve(path: Path, rate: float) -> None:
    """Write rig.toml, say so, and serve until the input ends."""
    async with LoopbackRig(SimConfig(rate=rate, view=VIEW, force_noise_n=0.0005)) as rig:
        rig.world.flaws.update(dict.fromkeys(range(MOST_PRESSES), (Flaw.SPLIT, 0.0)))
        path.write_text(rig.toml(), encoding="utf-8")
        asked = await lines_of_input()
        tell("ready")
        while line := await asked.readline():
            match line.decode().strip():
                case "split":
                    rig.world.flaws[len(rig.world.presses)] = (Flaw.SPLIT, 1.0)
                case "stop":
                    rig.arcs.cabinet.safety_stop()
                case "release":
                    rig.arcs.cabinet.power.safety = SafetyMode.NORMAL
                case _:
                    pass
            tell(str(rig.world.tool()))


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), float(sys.argv[2])))
