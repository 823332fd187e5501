"""The misfit of a twin: how captures differ from the marks of its mechanics, smoothed over depth and tilt.

Each capture is compared with the mean mark of the mechanics in its condition. The differences are smoothed as the
residuals of the fitted stroke model are, so that captures which repeat badly are followed less.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.fit.fit import END_MM, regress
from brushloop.drivers.sim.brush.footprint import Footprint
from brushloop.drivers.sim.brush.misfit import MODES, SHARES, Misfit, command_terms, profile, waves
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.model.presses import DepthTilt, Grid
from brushloop.twin.brush import STILL, Place, Vector, draw, reached_mm

VOTES = 7
"""Presses of the twin that are averaged to one mark."""
FIRST_SEED = 900
LITTLE = 0.3
"""Added to the squares of the modes, so that the edge of one capture is not followed everywhere."""
DIGITS = 5


def fit_misfit(
    spec: BrushSpec, place: Place, captured: Mapping[DepthTilt, NDArray[np.floating]], grid: Grid
) -> Misfit | None:
    """The misfit of the captures, (n, len(y_mm), len(x_mm)) ink of each condition; None where there is no ink."""
    marks = draw(replace(spec, **STILL), place, tuple(captured), grid, VOTES, FIRST_SEED)
    apart, terms = list[Vector](), list[Vector]()
    for (depth_mm, tilt_deg), drawn, inks in zip(captured, marks, captured.values(), strict=True):
        expected = [one for one in (_measured(image, grid) for image in drawn) if one is not None]
        found = [one for one in (_measured(image, grid) for image in inks) if one is not None]
        if expected and found:
            apart += [one - np.mean(expected, axis=0) for one in found]
            terms += [command_terms(reached_mm(depth_mm, place[0]), tilt_deg)] * len(found)
    if not apart:
        return None
    ends, middle, half = np.split(np.array(apart), [2, 2 + len(SHARES)], axis=1)
    each, falling = np.array(terms), 1.0 / np.arange(MODES).clip(1)
    tip, heel = (regress(end[:, None], each, np.array([END_MM]))[0] for end in (-ends[:, 0], ends[:, 1]))
    along = waves(SHARES)
    to_modes = np.linalg.solve(along.T @ along + LITTLE * np.eye(MODES), along.T)
    half, middle = (regress(seen @ to_modes.T, each, falling) for seen in (half, middle))
    depths_mm, tilts_deg = ([reached_mm(depth, place[0]) for depth, _ in captured], [tilt for _, tilt in captured])
    return Misfit(
        depths_mm=(min(depths_mm), max(depths_mm)),
        tilts_deg=(min(tilts_deg), max(tilts_deg)),
        tip=tip.round(DIGITS).tolist(),
        heel=heel.round(DIGITS).tolist(),
        half=half.round(DIGITS).tolist(),
        middle=middle.round(DIGITS).tolist(),
    )


def _measured(ink: NDArray[np.floating], grid: Grid) -> Vector | None:
    """Ends, middle and half width of one mark, (130,) mm."""
    origin_px = 0.5 - float(grid.x_mm[0]) / grid.px_mm, 0.5 + float(grid.y_mm[0]) / grid.px_mm
    measured = profile(Footprint(np.asarray(ink, np.float32), 1.0 / grid.px_mm, origin_px))
    return None if measured is None else np.concatenate(measured)
