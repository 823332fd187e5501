"""Whether intervals of recovered presses hold the command on brushes that the model family does not contain.

Brushes, all simulated: the frozen five of the loopback rig and two of an independent bristle simulation. Each is fitted
to the first nine cells of the fixed design, with a prior that does not hold its family; all its presses are then
inverted as `brushloop invert` does, and those of the other six cells are scored.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.brushfit import DESIGN
from bench.brushfit_brushes import FROZEN
from bench.brushfit_presses import BRISTLE_SETS, CELLS, PX_MM, SIZE_PX, BrushPresses, bristles, simulated
from bench.brushfit_prior import BRISTLE
from bench.harness import BenchError, Result
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.fit.fit import fit_presses
from brushloop.calibrate.fit.prior import Prior, learned
from brushloop.calibrate.invert.invert import USELESS, Row, with_model_error
from brushloop.model.fitted import NAMES
from brushloop.model.fitted_shape import fitted_model
from brushloop.model.inversion.noise import Noise
from brushloop.model.inversion.press import Inverter, Known, Range

FITTED_CELLS, PRESSES = 9, 4
"""Cells that the brush is fitted to, and presses of each cell that are used."""
LEAST, MOST = 90.0, 99.0
NORMAL_95 = 1.96


@dataclass(frozen=True, slots=True)
class Recovery:
    """The presses of one brush, recovered: by the image alone, and with model error."""

    name: str
    alone: list[Row]
    rows: list[Row]
    refused: Counter[str]


def intervals(seed: int) -> Iterator[Result]:
    """Share of 95 % intervals that hold the command, on cells that the brush was not fitted to; 90 to 99 % is asked.

    `seed` draws which presses of each cell are used. The bristle sets are left out, and this is said, where they are
    not at hand.
    """
    fitted = {CELLS[c] for c in DESIGN[:FITTED_CELLS]}
    every: list[Row] = []
    for brush, prior in _brushes():
        found = recover(brush, prior, seed)
        others = [row for row in found.rows if (row.commanded_depth_mm, row.commanded_tilt_deg) not in fitted]
        alone = [row for row in found.alone if (row.commanded_depth_mm, row.commanded_tilt_deg) not in fitted]
        every += others
        flagged = Counter(flag for row in others for flag in row.flags) + found.refused
        reasons = ", ".join(f"{count} {flag}" for flag, count in sorted(flagged.items())) or "none"
        for letter, unit in (("H", "mm"), ("alpha", "deg")):
            sd = np.median([row.depth_sd_mm if letter == "H" else row.tilt_sd_deg or np.nan for row in found.rows])
            where = (
                f"all {len(found.rows)} presses: {held(found.rows, letter):.0f} %; left-out ones by the image alone "
                f"{held(alone, letter):.0f} %; median sd {sd:.2f} {unit}; flagged: {reasons}"
            )
            yield _result(found.name, letter, others, seed, where)
    for letter in ("H", "alpha"):
        yield _result("every brush", letter, every, seed, "left-out cells of every brush")


def _result(name: str, letter: str, rows: Sequence[Row], seed: int, where: str) -> Result:
    share = held(rows, letter)
    ratio = min(share / LEAST, MOST / max(share, 1.0))
    label = f"inversion-commands-{name.replace(' ', '-')}-{letter}"
    return Result(label, share, "%", "the goal of 90 to 99 %", ratio, len(rows), seed, f"simulated; {where}")


def recover(brush: BrushPresses, prior: Prior, seed: int) -> Recovery:
    """Fit the brush, and invert `PRESSES` presses of every cell."""
    rng = np.random.default_rng(seed)
    chosen = [(c, int(r)) for c in range(len(CELLS)) for r in rng.permutation(brush.ink.shape[1])[:PRESSES]]
    strokes = brush.strokes([(c, r) for c, r in chosen if c in DESIGN[:FITTED_CELLS]])
    press = fit_presses(strokes, brush.grid, brush.radius_mm, brush.length_mm, prior=prior)
    within = Range((max(2.0, 0.5 - float(press.values[NAMES.index("h0_mm")])), 30.0))
    inverter = Inverter.of_model(
        fitted_model(press), within=within, known=Known.ANCHOR, noise=Noise.BLOCKS, px_mm=PX_MM, anchor_sigma_mm=0.1
    )
    left, top = Field().anchor_mm
    images = np.zeros((len(chosen), SIZE_PX, SIZE_PX), np.float32)
    first = round((top - float(brush.grid.y_mm[0])) / PX_MM - 0.5)
    images[:, first : first + len(brush.grid.y_mm)] = [brush.ink[c, r] for c, r in chosen]
    found = inverter(images, (left, top))
    alone: list[Row] = []
    refused: Counter[str] = Counter()
    for k, (c, r) in enumerate(chosen):
        if useless := found.flags[k] & USELESS:
            refused.update(useless)
            continue
        (height, tilt), (height_sd, tilt_sd) = found.values[k, :2].tolist(), found.sigma[k, :2].tolist()
        flags = tuple(sorted(found.flags[k]))
        alone.append(Row(f"{c}-{r}", height, tilt, height_sd, tilt_sd, float(found.rms[k]), flags, *CELLS[c]))
    return Recovery(brush.name, alone, with_model_error(alone, {CELLS[c] for c in DESIGN[:FITTED_CELLS]}), refused)


def held(rows: Sequence[Row], letter: str) -> float:
    """Percent of the rows whose interval holds the command."""
    if letter == "H":
        off = [abs(r.depth_mm - (r.commanded_depth_mm or 0.0)) / r.depth_sd_mm for r in rows]
    else:
        off = [abs(r.tilt_deg - (r.commanded_tilt_deg or 0.0)) / (r.tilt_sd_deg or np.nan) for r in rows]
    return 100.0 * float(np.mean(np.array(off) <= NORMAL_95))


def _brushes() -> Iterator[tuple[BrushPresses, Prior]]:
    for number, spec in enumerate(FROZEN, 1):
        yield simulated(spec, f"frozen {number}", PRESSES), learned()
    try:
        for name in BRISTLE_SETS:
            yield bristles(name), learned((BRISTLE,))
    except BenchError as error:
        sys.stderr.write(f"inversion: {error}: scored on the loopback rig only\n")
