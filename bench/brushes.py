"""The brushes that benches press with, and sessions of their presses.

`FROZEN` was frozen before any score of a fitted model was looked at, and never tuned to one; the fit was developed on
`DEVELOPMENT`. They differ in size, stiffness, friction and set within what the simulated brush allows. Change none of
them: a new idea gets a new list. Two more brushes, pressed by an independent bristle simulation, are photographs in
`../shared/data`.
"""

from __future__ import annotations

import os
import re
import signal
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import ROOT, BenchError, brushloop, started
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.model.presses import spread_out
from brushloop.sessions.imports import ImportOptions, import_photographs

DEPTHS_MM, TILTS_DEG = (11.0, 13.0, 15.0, 17.0, 20.0), (0.0, 5.0, 10.0)
CELLS = tuple((depth_mm, tilt_deg) for depth_mm in DEPTHS_MM for tilt_deg in TILTS_DEG)
"""The paper's conditions."""
DESIGN = tuple(spread_out(list(DEPTHS_MM), list(TILTS_DEG)))
"""The same in the order of the fixed design: the first few describe a brush best."""
DATA = ROOT.parent / "shared" / "data"
BRISTLE_SETS = ("bristle_presses_1", "bristle_presses_4")
PX_MM, WIDTH_PX, HEIGHT_PX, TOUCH_PX = 10.0, 480, 300, (380, 150)
"""Scale and size of a photograph, and where the tip touches on it."""
MOST_SHEETS = 40
FINISHED = (0, 3)
"""Exit codes: done, or a collection that finished without some strokes."""
HEADER = "file,depth_mm,tilt_deg,px_per_mm,start_x_px,start_y_px"
Condition = tuple[float, float]
"""Depth in mm, tilt in deg."""

FROZEN: tuple[BrushSpec, ...] = (
    BrushSpec(seed=11),
    BrushSpec(radius_mm=5.0, length_mm=42.0, stiffness_n_mm2=150.0, friction=0.18, set_deg=10.0, seed=12),
    BrushSpec(radius_mm=7.0, length_mm=52.0, stiffness_n_mm2=260.0, friction=0.25, set_deg=6.0, seed=13),
    BrushSpec(
        radius_mm=6.0,
        length_mm=44.0,
        stiffness_n_mm2=320.0,
        stiffness_power=3.2,
        squash_n_per_mm2=0.012,
        friction=0.15,
        seed=14,
    ),
    BrushSpec(length_mm=50.0, stiffness_n_mm2=120.0, suction_n_per_mm2=0.002, friction=0.3, set_deg=12.0, seed=15),
)
NAMED = {f"frozen-{k}": spec for k, spec in enumerate(FROZEN, 1)}
DEVELOPMENT: tuple[BrushSpec, ...] = (
    BrushSpec(seed=1),
    BrushSpec(radius_mm=5.5, length_mm=46.0, stiffness_n_mm2=240.0, friction=0.2, seed=2),
    *(
        BrushSpec(
            radius_mm=radius,
            length_mm=length,
            stiffness_n_mm2=stiffness,
            stiffness_power=power,
            suction_n_per_mm2=suction,
            friction=friction,
            set_deg=set_deg,
            seed=seed,
        )
        for radius, length, stiffness, power, suction, friction, set_deg, seed in (
            (6.57, 47.5, 169.0, 3.4, 0.0, 0.198, 8.3, 21),
            (5.18, 45.7, 278.0, 3.66, 0.002, 0.241, 6.8, 22),
            (5.72, 50.7, 316.0, 3.62, 0.0, 0.174, 11.3, 23),
            (5.68, 45.5, 198.0, 3.27, 0.0, 0.178, 10.5, 24),
            (5.15, 45.9, 121.0, 3.48, 0.002, 0.163, 6.2, 25),
            (5.41, 50.1, 174.0, 3.68, 0.002, 0.216, 10.0, 26),
            (5.84, 51.2, 224.0, 3.7, 0.002, 0.269, 10.3, 31),
            (5.76, 45.2, 236.0, 3.6, 0.002, 0.293, 9.0, 32),
            (6.43, 49.1, 294.0, 3.34, 0.002, 0.296, 8.5, 33),
        )
    ),
)
"""Two by hand, nine drawn at random within the ranges that the frozen ones span; the last three have much friction."""


def press_session(out: Path, spec: BrushSpec, conditions: Sequence[Condition], seed: int = 0) -> Path:
    """A new session folder with one press for each of these conditions, photographed from above and imported."""
    brush = Brush(spec)
    lines = [HEADER]
    with tempfile.TemporaryDirectory() as folder:
        photos = Path(folder)
        for k, (depth_mm, tilt_deg) in enumerate(conditions):
            cv2.imwrite(str(photos / f"{k:04d}.png"), photograph(brush, depth_mm, tilt_deg, seed + k))
            lines.append(f"{k:04d}.png,{depth_mm},{tilt_deg},{PX_MM},{TOUCH_PX[0]},{TOUCH_PX[1]}")
        (photos / "strokes.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        options = ImportOptions(
            kind="press", simulated=True, brush_radius_mm=spec.radius_mm, brush_length_mm=spec.length_mm
        )
        import_photographs(photos, photos / "strokes.csv", out, options, "bench", lambda: 1)
    return out


def bristle_session(out: Path, name: str) -> Path:
    """A session of one of `BRISTLE_SETS`. Raises BenchError where the photographs are not beside this checkout."""
    photos = at_hand(name)
    options = ImportOptions(kind="press", simulated=True)
    import_photographs(photos, photos / "strokes.csv", out, options, "bench", lambda: 1)
    return out


def at_hand(name: str) -> Path:
    """The folder of a data set. Raises BenchError where it is not beside this checkout."""
    if not (DATA / name / "strokes.csv").exists():
        raise BenchError(f"{name} is not in ../shared/data beside this checkout")
    return DATA / name


def photograph(brush: Brush, depth_mm: float, tilt_deg: float, seed: int) -> NDArray[np.uint8]:
    """A press on white paper, without noise, its tip touching at `TOUCH_PX`."""
    mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=seed)
    page = np.full((HEIGHT_PX, WIDTH_PX), 235, np.uint8)
    rows, columns = mark.density.shape
    left, top = TOUCH_PX[0] - round(mark.origin_px[0]), TOUCH_PX[1] - round(mark.origin_px[1])
    page[top : top + rows, left : left + columns] = 235 - np.rint(200 * np.clip(mark.density, 0, 1)).astype(np.uint8)
    return page


def brush_toml(path: Path, spec: BrushSpec, name: str) -> Path:
    """Write the brush as a file for `brushloop sim --brush`."""
    fields = "\n".join(f"{key} = {value!r}" for key, value in asdict(spec).items())
    path.write_text(f'name = "{name}"\n[brush]\n{fields}\n', encoding="utf-8")
    return path


@dataclass(frozen=True, slots=True)
class SimulatedRig:
    """A running `brushloop sim`: its rig.toml, and the socket through which a person acts on it."""

    toml: Path
    control: Path

    def run(self, *words: str | Path) -> None:
        """Run a command that moves the arm to its end; whenever it asks for a fresh sheet, one is laid.

        A collection that finished without some strokes counts as finished. Raises BenchError where the command fails.
        """
        sheet: list[str] = []
        for _ in range(MOST_SHEETS):
            ran = brushloop(*words, "--config", self.toml, "--no-tui", *sheet, ends=range(256))
            if ran.returncode in FINISHED:
                return
            asked = re.search(r"--sheet\s+(\d+)", ran.stderr)
            if asked is None:
                raise BenchError(f"`brushloop {words[0]}` ended with {ran.returncode}: {ran.stderr.strip()[-400:]}")
            brushloop("sim", "fault", self.control, "fresh-sheet")
            sheet = ["--sheet", asked[1]]
        raise BenchError(f"`brushloop {words[0]}` has asked for {MOST_SHEETS} sheets")


@contextmanager
def simulated_rig(folder: Path, brush: str | Path, rate: float, seed: int) -> Iterator[SimulatedRig]:
    """`brushloop sim` with a shipped brush or one of a file, in a process of its own until the block ends."""
    rig = SimulatedRig(folder / "rig.toml", folder / "rig.sock")
    words = ("--brush", brush, "--rate", f"{rate:g}", "--seed", str(seed), "--fps", "3")
    with started("brushloop", "sim", *words, "--write-rig", rig.toml, "--control", rig.control) as process:
        try:
            yield rig
        finally:
            os.kill(process.pid, signal.SIGINT)


def collect_grid(
    folder: Path, rig: SimulatedRig, depths_mm: Sequence[float], tilts_deg: Sequence[float], repeats: int, seed: int
) -> Path:
    """A session that the rig presses: every depth at every tilt, so many times. Raises BenchError where it fails."""
    protocol, sessions = folder / "protocol.toml", folder / "sessions"
    grid = f'kind = "grid"\ndepths_mm = {list(depths_mm)}\ntilts_deg = {list(tilts_deg)}\nrepeats = {repeats}\n'
    protocol.write_text(f"{grid}seed = {seed}\n", encoding="utf-8")
    rig.run("collect", "--protocol", protocol, "--out", sessions)
    [session] = sessions.iterdir()
    return session
