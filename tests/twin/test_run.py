"""The order of a twin's fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brushloop.calibrate.fit.captures import Grid, Pressed
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.twin.constants import Offset
from brushloop.twin.drawing import draw
from brushloop.twin.run import fit_twin
from brushloop.twin.shape import Found, Round, Target
from tests.twin.serial import Serial

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))


def test_the_shape_is_found_with_hairs_that_stray_as_those_of_the_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    strays: list[tuple[float, float]] = []

    def counted(target: Target, found: Found, one: Round, *_: object) -> Found:
        strays.append((one.blur_mm, target.base.strand_mm))
        return found  # how a search finds its way is tested beside it

    for name, value in {"COARSE": (Round(1.0, 1),), "FINE": Round(0.5, 1), "search": counted}.items():
        monkeypatch.setattr(f"brushloop.twin.run.{name}", value)
    monkeypatch.setattr("brushloop.twin.shape.INDIVIDUALS", range(1))
    cell = (3.0, 0.0)
    brush = replace(BrushSpec(), strand_mm=0.5)
    captured = draw(brush, Offset(0.0, 0.0, 0.0), [cell], GRID, repeats=4)[0]
    twin = fit_twin([Pressed(*cell, ink) for ink in captured], GRID, brush.radius_mm, brush.length_mm, Serial())
    assert strays == [(1.0, BrushSpec().strand_mm), (0.5, pytest.approx(twin.spec.strand_mm, rel=0.2))]
    assert twin.spec.strand_mm > BrushSpec().strand_mm
