"""Ink on paper: how much of the ink offered the paper absorbs, and the sheet that collects all footprints."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.brush.mechanics import Vector
from brushloop.drivers.sim.brush.spec import BrushSpec

Image = NDArray[np.float32]

PX_PER_MM = 10.0
"""Scale of the sheet, and of the marks that are laid on it."""

TEXTURE_PX_PER_MM = 10.0
"""Paper texture is drawn at this scale and resized, so that fibres keep their size on any raster."""

DRY_WICK_MM = 0.04
"""Capillary spread of the last ink of a brush."""

HAIR_MM = 0.1
"""Spread of ink around one wet hair."""

FULL_PER_MM2 = 20.0
"""Deposit points per area that fill the ink film."""


@dataclass(frozen=True, slots=True)
class Dots:
    """Deposit points on the paper."""

    x_mm: Vector
    y_mm: Vector
    ink: Vector


@dataclass(frozen=True, slots=True)
class Footprint:
    """One press on an unbounded sheet; columns grow with +x (where the ferrule leans), rows with -y."""

    density: Image
    """(h, w) ink per area, 0 = none, 1 = saturated."""
    px_per_mm: float
    origin_px: tuple[float, float]
    """(x, y) of the zero-touch point; pixel (i, j) covers [j, j + 1) x [i, i + 1)."""


def scatter(
    dots: Dots,
    shape_px: tuple[int, int],
    origin: tuple[float, float],
    px_per_mm: float,
    ink_load: float,
    spec: BrushSpec,
) -> Image:
    """Ink offered per area, (h, w): dots spread by the width of a wet hair and its meniscus."""
    h, w = shape_px
    column = np.floor(origin[0] + dots.x_mm * px_per_mm).astype(np.int64).clip(0, w - 1)
    row = np.floor(origin[1] - dots.y_mm * px_per_mm).astype(np.int64).clip(0, h - 1)
    offered = np.bincount(row * w + column, weights=dots.ink, minlength=h * w).reshape(h, w)
    per_mm2 = (offered * px_per_mm**2).astype(np.float32)
    lines = np.asarray(cv2.GaussianBlur(per_mm2, (0, 0), HAIR_MM * px_per_mm), np.float32)
    # hairs on top of each other, as at the tip, hold no more ink between them than the film does
    np.minimum(lines, FULL_PER_MM2, out=lines)
    wick_mm = DRY_WICK_MM + (spec.wick_mm - DRY_WICK_MM) * ink_load
    return np.asarray(cv2.GaussianBlur(lines, (0, 0), wick_mm * px_per_mm), np.float32)


def soak(wet: Image, ink_load: float | Image, px_per_mm: float, rng: np.random.Generator, spec: BrushSpec) -> Image:
    """Ink absorbed, (h, w) in 0 .. 1: fibres decide at the edge and, when the brush is dry, everywhere.

    `ink_load` is one number, or for a drag the load of the brush when it passed each pixel.
    """
    texture = _paper(wet.shape, px_per_mm, rng)
    # a drier brush wets only the peaks of the paper
    need = (spec.need_per_mm2 + 6.0 * (1.0 - ink_load) ** 2) * np.exp((0.2 + 0.9 * (1.0 - ink_load)) * texture)
    cover = wet**3 / (wet**3 + need**3)
    cover = np.asarray(cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 0.05 * px_per_mm), np.float32)
    pooled = 1.0 - np.exp(-wet / 6.0)
    tone = (0.55 + 0.45 * ink_load) * (0.75 + 0.25 * pooled) * (1.0 - 0.03 * texture)
    density = np.clip(cover * tone, 0.0, 1.0)
    density[density < 0.01] = 0.0
    return density.astype(np.float32)


def _paper(shape_px: tuple[int, ...], px_per_mm: float, rng: np.random.Generator) -> Image:
    """Paper texture (h, w) of unit variance: long fibres in three directions over a fine grain."""
    h, w = (int(np.ceil(n * TEXTURE_PX_PER_MM / px_per_mm)) + 1 for n in shape_px)
    field = np.asarray(cv2.GaussianBlur(rng.standard_normal((h, w), np.float32), (0, 0), 1.2), np.float32)
    field /= field.std()
    for angle in (rng.random() + np.arange(3)) * np.pi / 3.0:
        fibres = np.asarray(
            cv2.filter2D(rng.standard_normal((h, w), np.float32), -1, _fibre_kernel(float(angle))), np.float32
        )
        field += fibres / fibres.std()
    field /= field.std()
    sheet = np.empty(shape_px, np.float32)
    cv2.resize(field, (shape_px[1], shape_px[0]), dst=sheet, interpolation=cv2.INTER_LINEAR)
    return sheet


def _fibre_kernel(angle_rad: float) -> Image:
    """An elongated Gaussian, 1.2 mm by 0.12 mm at the texture's scale."""
    y, x = np.mgrid[-12:13, -12:13]
    along = x * np.cos(angle_rad) + y * np.sin(angle_rad)
    aside = y * np.cos(angle_rad) - x * np.sin(angle_rad)
    return np.exp(-0.5 * ((along / 6.0) ** 2 + (aside / 0.6) ** 2)).astype(np.float32)


class Paper:
    """Ink per area on a sheet of (width, height) mm; row 0 is the far edge (largest y), as a camera sees it."""

    def __init__(self, size_x_mm: float, size_y_mm: float) -> None:
        self.size_x_mm = size_x_mm
        self.size_y_mm = size_y_mm
        shape = (round(size_y_mm * PX_PER_MM), round(size_x_mm * PX_PER_MM))
        self._density: NDArray[np.float32] = np.zeros(shape, np.float32)
        self._coming: deque[tuple[Callable[[], Footprint], float, float, float]] = deque()
        self._lock = threading.Lock()

    @property
    def density(self) -> NDArray[np.float32]:
        """Ink per area, (rows, columns), 0 to 1, including every mark laid so far."""
        with self._lock:
            while self._coming:
                make, x_mm, y_mm, heading_deg = self._coming[0]
                self._lay(make(), x_mm, y_mm, heading_deg)
                self._coming.popleft()
            return self._density

    @density.setter
    def density(self, density: NDArray[np.float32]) -> None:
        with self._lock:
            self._coming.clear()
            self._density = density

    def lay_later(self, make: Callable[[], Footprint], x_mm: float, y_mm: float, heading_deg: float) -> None:
        """When the sheet is next read, call `make` in the reader's thread and lay the footprint that it returns.

        A footprint takes a tenth of a second to compute, too long for the thread that moves the arm.
        """
        self._coming.append((make, x_mm, y_mm, heading_deg))

    def lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        """Lay a footprint with its zero-touch point at (x, y) and its +x along the heading, on top of earlier ink.

        Its scale is that of the sheet.
        """
        self.lay_later(lambda: footprint, x_mm, y_mm, heading_deg)

    def _lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        cos, sin = math.cos(math.radians(heading_deg)), math.sin(math.radians(heading_deg))
        # Rows run against y, so a counter-clockwise heading is clockwise in row and column.
        linear = np.array([[cos, sin], [-sin, cos]])
        anchor = np.array([x_mm * PX_PER_MM, (self.size_y_mm - y_mm) * PX_PER_MM])
        # cv2 puts pixel centres on integers, our coordinates put them on halves.
        half = np.array([0.5, 0.5])
        offset = anchor - linear @ (np.array(footprint.origin_px) - half) - half
        rows, columns = self._density.shape
        laid = cv2.warpAffine(footprint.density, np.column_stack([linear, offset]), (columns, rows))
        height, width = footprint.density.shape
        corners = offset + np.array([(-1, -1), (width, -1), (width, height), (-1, height)]) @ linear.T
        left, top = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 1, 0)
        right, bottom = np.maximum(np.ceil(corners.max(axis=0)).astype(int) + 2, 0)
        inked = np.s_[top:bottom, left:right]
        density = self._density.copy()  # other threads may hold the old array
        density[inked] = 1.0 - (1.0 - density[inked]) * (1.0 - np.clip(laid[inked], 0.0, 1.0))
        self._density = density
