"""`python -m bench.brushfit_prior`: fit the brushes that the prior of the brush fit is made of, and write prior.json.

Its families: the two bristle sets from an independent simulation, and three families in closed form. Brushes of the
loopback rig are not among them, so that scores on the rig are those of a brush that nobody knew. Each brush is fitted
with a prior about the published model, so the file does not depend on its earlier contents.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from bench.brushfit_families import BRUSHES, FAMILIES, made_up
from bench.brushfit_presses import BRISTLE_SETS, CELLS, bristles, grid
from brushloop.calibrate.fit.captures import Grid, Pressed
from brushloop.calibrate.fit.fit import fit_presses
from brushloop.calibrate.fit.prior import FILE, KnownBrush, KnownBrushes, about
from brushloop.model.fitted import published

BRISTLE = "bristle simulation"


def known() -> Iterator[KnownBrush]:
    """Every brush of the prior, fitted."""
    for name in BRISTLE_SETS:
        made = bristles(name)
        yield _fitted(name, BRISTLE, made.every(), made.grid, made.radius_mm, made.length_mm)
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


def _fitted(name: str, family: str, strokes: list[Pressed], on: Grid, radius_mm: float, length_mm: float) -> KnownBrush:
    press = fit_presses(strokes, on, radius_mm, length_mm, residual=False, prior=about(published()))
    return KnownBrush(name=name, family=family, values=tuple(round(float(v), 5) for v in press.values))


if __name__ == "__main__":
    main()
