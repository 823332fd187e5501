"""`python -m bench.loop_rig FILE BRUSH RATE [SEED]`: a loopback rig with a brush, until its input ends.

BRUSH is the number of a frozen brush, from 0, or `paper`.

Each line on its input puts a fresh sheet in and is answered.
"""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from bench.brushfit_brushes import FROZEN
from bench.processes import lines_of_input, tell
from brushloop.drivers.sim.brush_file import PAPER, load_brush
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig


async def serve(path: Path, brush: str, rate: float, seed: int | None = None) -> None:
    """Write rig.toml, say so, and serve. Without a seed of its own the rig takes its brush's."""
    spec = load_brush(Path(PAPER)).spec if brush == PAPER else FROZEN[int(brush)]
    config = SimConfig(seed=spec.seed if seed is None else seed, rate=rate, brush=spec)
    async with LoopbackRig(config) as rig:
        path.write_text(rig.toml(), encoding="utf-8")
        asked = await lines_of_input()
        tell("ready")
        while await asked.readline():
            rig.world.fresh_sheet()
            tell("fresh")


if __name__ == "__main__":
    asyncio.run(serve(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), *map(int, sys.argv[4:])))
