"""What the mechanics of a twin cannot express: how its marks differ from those of the brush that it imitates.

A mark has a tip and a heel, and at each share of the way from one to the other a middle and a half width across. These
differ from the mechanics: the ends by polynomials in depth and tilt, middle and half width by polynomials along the
mark with such coefficients. The printed mark is stretched until it agrees, so that its ink stays as it was printed.
"""

from typing import Annotated

import cv2
import numpy as np
from pydantic import BaseModel, Field

from brushloop.drivers.sim.brush.footprint import MARGIN_MM, Footprint, frame_around
from brushloop.drivers.sim.brush.mechanics import Vector

SHARES = (np.arange(64) + 0.5) / 64
"""Where a mark is measured, from 0 at its tip to 1 at its heel."""
TERMS, MODES = 6, 12
DEPTH_MM, DEPTH_SPAN_MM, TILT_DEG = 15.0, 4.5, 5.0
"""The middles of the paper's depths and tilts; the depths reach `DEPTH_SPAN_MM` from there, the tilts `TILT_DEG`."""
INKED = 0.4
"""Density, as a share of the mark's greatest, from which a place counts as inked."""
LEAST_HALF_MM = 0.1
SHORTEST, LONGEST = 0.4, 1.0
"""Share of its length by which an end of a mark may be drawn in; and by which an end or an edge may be drawn out."""
Number = Annotated[float, Field(ge=-50.0, le=50.0)]
Polynomial = Annotated[tuple[Number, ...], Field(min_length=TERMS, max_length=TERMS)]
"""Coefficients, in mm, of 1, depth, tilt, their product and their squares, about their middles."""
Along = Annotated[tuple[Polynomial, ...], Field(min_length=MODES, max_length=MODES)]
"""One for each polynomial of `waves`."""
Command = Annotated[float, Field(ge=0.0, le=120.0)]


def profile(mark: Footprint) -> tuple[Vector, Vector, Vector] | None:
    """The x of tip and heel (2,), then middle and half width at `SHARES` (64,), all in mm; None without ink."""
    ink = mark.density > INKED * mark.density.max()
    columns = np.flatnonzero(ink.any(axis=0))
    if not columns.size:
        return None
    inked = ink[:, columns]
    top, bottom = inked.argmax(axis=0), len(ink) - inked[::-1].argmax(axis=0)
    x_mm = (columns.astype(np.float64) + 0.5 - mark.origin_px[0]) / mark.px_per_mm
    edges = mark.origin_px[1] - 0.5 * (top + bottom), 0.5 * (bottom - top)
    ends = x_mm[[0, -1]] + np.array([-0.5, 0.5]) / mark.px_per_mm
    at = ends[0] + SHARES * (ends[1] - ends[0])
    middle, half = (_between(at, x_mm, edge / mark.px_per_mm) for edge in edges)
    return ends, middle, half


def _between(at: Vector, x: Vector, values: Vector) -> Vector:
    return np.asarray(np.interp(at, x, values), np.float64)


def command_terms(depth_mm: float, tilt_deg: float) -> Vector:
    """The terms of a polynomial, (TERMS,)."""
    h, a = (depth_mm - DEPTH_MM) / DEPTH_SPAN_MM, (tilt_deg - TILT_DEG) / TILT_DEG
    return np.array([1.0, h, a, h * a, h * h, a * a])


def waves(share: Vector) -> Vector:
    """Chebyshev polynomials of 1 - 2 share, (len(share), MODES): they resolve the ends better than the middle."""
    return np.cos(np.arccos(1.0 - 2.0 * share)[:, None] * np.arange(MODES))


class Misfit(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """How the marks of presses differ from those of the mechanics; drags and forces are those of the mechanics."""

    depths_mm: tuple[Command, Command]
    tilts_deg: tuple[Command, Command]
    """The presses to which it was fitted; beyond them it is that of the nearest, and less in a shallower press."""
    tip: Polynomial
    heel: Polynomial
    """How much further the ends reach."""
    half: Along
    middle: Along

    def bend(self, mark: Footprint, depth_mm: float, tilt_deg: float) -> Footprint:
        """The mark of a press, stretched from what the mechanics print to what the brush leaves."""
        if (measured := profile(mark)) is None:
            return mark
        terms = command_terms(np.clip(depth_mm, *self.depths_mm), np.clip(tilt_deg, *self.tilts_deg))
        terms *= np.interp(depth_mm, (0.0, self.depths_mm[0]), (0.0, 1.0))
        was, middle, half = measured
        long, along = was[1] - was[0], waves(SHARES)
        tip, heel = np.clip(np.array([self.tip, self.heel]) @ terms, -SHORTEST * long, LONGEST * long)
        ends = was + np.array([-tip, heel])
        aside, more = (np.clip(along @ (np.array(each) @ terms), -long, long) for each in (self.middle, self.half))
        bowed, wider = middle + aside, np.maximum(half + more, LEAST_HALF_MM)
        edges = np.concatenate([bowed - wider, bowed + wider])
        (rows, columns), origin_px = frame_around(ends, edges, mark.px_per_mm, MARGIN_MM)
        x_mm = (np.arange(0.5, columns) - origin_px[0]) / mark.px_per_mm
        y_mm = (origin_px[1] - np.arange(0.5, rows)[:, None]) / mark.px_per_mm
        share = (x_mm - ends[0]) / (ends[1] - ends[0])
        middle, half, bowed, wider = (_between(share, SHARES, each) for each in (middle, half, bowed, wider))
        from_y = middle + (y_mm - bowed) * np.maximum(half, LEAST_HALF_MM) / wider
        column = np.broadcast_to(mark.origin_px[0] + (was[0] + share * long) * mark.px_per_mm - 0.5, (rows, columns))
        row = mark.origin_px[1] - from_y * mark.px_per_mm - 0.5
        density = cv2.remap(mark.density, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        return Footprint(np.asarray(density, np.float32), mark.px_per_mm, origin_px)
