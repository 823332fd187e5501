"""`python -m bench.brushfit_prior`: fit the brushes that the prior of the brush fit is made of, and write prior.json.

Its families: brushes of the loopback rig (`DEVELOPMENT`, never the frozen ones), the two bristle sets from an
independent simulation, and three families in closed form. Each brush is fitted with the wide prior, so the file does
not depend on its earlier contents.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from bench.brushfit_brushes import DEVELOPMENT
from bench.brushfit_families import BRUSHES, FAMILIES, made_up
from bench.brushfit_presses import BRISTLE_SETS, CELLS, BrushPresses, bristles, grid, simulated
from calibrate.fit.captures import Grid, Pressed
from calibrate.fit.fit import fit_presses
from calibrate.fit.prior import FILE, KnownBrush, KnownBrushes, wide

SIMULATED_REPEATS = 2
RIG, BRISTLE = "loopback rig", "bristle simulation"


def known() -> Iterator[KnownBrush]:
    """Every brush of the prior, fitted."""
    for number, spec in enumerate(DEVELOPMENT):
        yield _of(RIG, simulated(spec, f"development {number + 1}", SIMULATED_REPEATS))
    for name in BRISTLE_SETS:
        yield _of(BRISTLE, bristles(name))
    for family in FAMILIES:
        for number in range(BRUSHES):
            brush = made_up(family, number)
            strokes = [brush.press(*cell, grid()) for cell in CELLS]
            yield _fitted(f"{family} {number + 1}", family, strokes, grid(), brush.radius_mm, brush.length_mm)


def main() -> None:
    """Write the file."""
    found = KnownBrushes(brushes=tuple(known()))
    rows = ",\n  ".join(brush.model_dump_json() for brush in found.brushes)
    FILE.write_text(f'{{"brushes": [\n  {rows}\n]}}\n', encoding="utf-8")
    sys.stdout.write(f"{len(found.brushes)} brushes: {FILE}\n")


def _of(family: str, presses: BrushPresses) -> KnownBrush:
    return _fitted(presses.name, family, presses.every(), presses.grid, presses.radius_mm, presses.length_mm)


def _fitted(name: str, family: str, strokes: list[Pressed], on: Grid, radius_mm: float, length_mm: float) -> KnownBrush:
    press = fit_presses(strokes, on, radius_mm, length_mm, residual=False, prior=wide()).press
    return KnownBrush(name=name, family=family, values=tuple(round(float(v), 5) for v in press.values))


if __name__ == "__main__":
    main()
