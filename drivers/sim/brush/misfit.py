"""What the mechanics of a twin cannot express: how its marks differ from those of the brush that it imitates.

A mark has a tip and a heel, and at each share of the way from one to the other a middle and a half width across. Both
ends, and the sines of which middle and half width consist, differ from those of the mechanics by polynomials in depth
and tilt. The printed mark is stretched until it agrees, so that its ink stays as it was printed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from brushloop.drivers.sim.brush.footprint import MARGIN_MM, Footprint, frame_around

Floats = NDArray[np.float64]
SHARES = (np.arange(64) + 0.5) / 64
"""Where a mark is measured, from 0 at its tip to 1 at its heel."""
TERMS, MODES = 6, 10
DEPTH_MM, DEPTH_SPAN_MM, TILT_DEG = 15.0, 4.5, 5.0
"""The middles of the paper's depths and tilts; the depths reach `DEPTH_SPAN_MM` from there, the tilts `TILT_DEG`."""
INKED = 0.3
"""Density, as a share of the mark's greatest, from which a place counts as inked."""
LEAST_HALF_MM = 0.1
SHORTEST, LONGEST = 0.4, 1.0
"""Share of its length by which an end of a mark may be drawn in; and by which an end or an edge may be drawn out."""
Number = Annotated[float, Field(ge=-50.0, le=50.0)]
Polynomial = Annotated[tuple[Number, ...], Field(min_length=TERMS, max_length=TERMS)]
"""Coefficients, in mm, of 1, depth, tilt, their product and their squares, about their middles."""
Along = Annotated[tuple[Polynomial, ...], Field(min_length=MODES, max_length=MODES)]
"""One polynomial for each sine along the mark."""
Depth = Annotated[float, Field(ge=0.1, le=120.0)]
Tilt = Annotated[float, Field(ge=0.0, le=90.0)]


@dataclass(frozen=True, slots=True, eq=False)
class Profile:
    """The measures of one mark, in mm; x and y as in its grid."""

    ends: Floats
    """(2,) x of the tip and of the heel."""
    middle: Floats
    """(64,) y halfway between the edges, at `SHARES`."""
    half: Floats
    """(64,) half the distance between the edges."""

    @classmethod
    def of(cls, ink: NDArray[np.bool_], x_mm: Floats, y_mm: Floats) -> Profile | None:
        """The profile of ink (len(y_mm), len(x_mm)), rows from the top; None without ink."""
        columns = np.flatnonzero(ink.any(axis=0))
        if not columns.size:
            return None
        inked, half_px = ink[:, columns], 0.5 * (x_mm[1] - x_mm[0])
        top, bottom = y_mm[inked.argmax(axis=0)], y_mm[::-1][inked[::-1].argmax(axis=0)]
        ends = np.array([x_mm[columns[0]] - half_px, x_mm[columns[-1]] + half_px])
        at = ends[0] + SHARES * (ends[1] - ends[0])
        edges: tuple[Floats, Floats] = (0.5 * (top + bottom), 0.5 * (top - bottom) + half_px)
        middle, half = (np.asarray(np.interp(at, x_mm[columns], edge), np.float64) for edge in edges)
        return cls(ends, middle, half)


def command_terms(depth_mm: float, tilt_deg: float) -> Floats:
    """The terms of a polynomial, (TERMS,)."""
    h, a = (depth_mm - DEPTH_MM) / DEPTH_SPAN_MM, (tilt_deg - TILT_DEG) / TILT_DEG
    return np.array([1.0, h, a, h * a, h * h, a * a])


def waves(share: Floats) -> Floats:
    """sin(k pi share) for k = 1 .. MODES, (len(share), MODES)."""
    return np.sin(np.pi * share[:, None] * np.arange(1, MODES + 1))


class Misfit(BaseModel, frozen=True, extra="forbid", allow_inf_nan=False):
    """How the marks of a brush differ from those of its mechanics."""

    depths_mm: tuple[Depth, Depth]
    tilts_deg: tuple[Tilt, Tilt]
    """The presses to which it was fitted; beyond them it is that of the nearest, and less in a shallower press."""
    tip: Polynomial
    heel: Polynomial
    """How much further the ends reach."""
    half: Along
    middle: Along

    def bend(self, mark: Footprint, depth_mm: float, tilt_deg: float) -> Footprint:
        """The mark of a press, stretched from what the mechanics print to what the brush leaves."""
        rows, columns = mark.density.shape
        x_mm, y_mm = _centres(rows, columns, mark.origin_px, mark.px_per_mm)
        was = Profile.of(mark.density > INKED * max(float(mark.density.max()), INKED), x_mm, y_mm)
        if was is None:
            return mark
        terms = command_terms(np.clip(depth_mm, *self.depths_mm), np.clip(tilt_deg, *self.tilts_deg))
        terms *= min(1.0, depth_mm / self.depths_mm[0])
        long = was.ends[1] - was.ends[0]
        tip, heel = (np.clip(np.array(end) @ terms, -SHORTEST * long, LONGEST * long) for end in (self.tip, self.heel))
        ends = was.ends + np.array([-tip, heel])
        half, middle = (np.array(along) @ terms for along in (self.half, self.middle))

        def across(share: Floats) -> tuple[Floats, Floats, Floats, Floats]:
            """Middle and half width at shares of the way along the mark, before and after."""
            begin, reach = (np.interp(share, SHARES, each) for each in (was.middle, was.half))
            sines, most = waves(np.clip(share, 0.0, 1.0)), LONGEST * long
            aside, more = (np.clip(sines @ each, -most, most) for each in (middle, half))
            return begin, np.maximum(reach, LEAST_HALF_MM), begin + aside, np.maximum(reach + more, LEAST_HALF_MM)

        *_, centre, reach = across(SHARES)
        edges = np.concatenate([centre - reach, centre + reach])
        shape_px, origin_px = frame_around(ends, edges, mark.px_per_mm, MARGIN_MM)
        x_mm, y_mm = _centres(*shape_px, origin_px, mark.px_per_mm)
        share = (x_mm - ends[0]) / (ends[1] - ends[0])
        begin, reach, centre, wide = across(share)
        from_x = np.broadcast_to(was.ends[0] + share * long, shape_px)
        from_y = begin + (y_mm[:, None] - centre) * (reach / wide)
        column = from_x * mark.px_per_mm + mark.origin_px[0] - 0.5
        row = mark.origin_px[1] - from_y * mark.px_per_mm - 0.5
        density = cv2.remap(mark.density, column.astype(np.float32), row.astype(np.float32), cv2.INTER_LINEAR)
        return Footprint(np.asarray(density, np.float32), mark.px_per_mm, origin_px)


def _centres(rows: int, columns: int, origin_px: tuple[float, float], px_per_mm: float) -> tuple[Floats, Floats]:
    """x of each column and y of each row of a footprint, from the point of touch."""
    across, down = (np.arange(count, dtype=np.float64) + 0.5 for count in (columns, rows))
    return (across - origin_px[0]) / px_per_mm, (origin_px[1] - down) / px_per_mm
