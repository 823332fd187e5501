"""From ink offered to ink taken up: the wet width of a hair, capillary spread, paper fibres and tone."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.brush.spine import Vector

Image = NDArray[np.float32]

TEXTURE_PX_PER_MM = 10.0
"""Paper texture is drawn at this scale and resized, so that fibres keep their size on any raster."""

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


def scatter(
    dots: Dots, shape_px: tuple[int, int], origin: tuple[float, float], px_per_mm: float, ink_load: float
) -> Image:
    """Ink offered per area, (h, w): dots spread by the width of a wet hair and its meniscus."""
    h, w = shape_px
    column = np.floor(origin[0] + dots.x_mm * px_per_mm).astype(np.int64).clip(0, w - 1)
    row = np.floor(origin[1] - dots.y_mm * px_per_mm).astype(np.int64).clip(0, h - 1)
    offered = np.bincount(row * w + column, weights=dots.ink, minlength=h * w).reshape(h, w)
    per_mm2 = (offered * px_per_mm**2).astype(np.float32)
    lines = np.asarray(cv2.GaussianBlur(per_mm2, (0, 0), HAIR_MM * px_per_mm), np.float32)
    # hairs that lie on top of each other, as at the tip, hold no more ink between them than the film does
    np.minimum(lines, FULL_PER_MM2, out=lines)
    return np.asarray(cv2.GaussianBlur(lines, (0, 0), (0.04 + 0.18 * ink_load) * px_per_mm), np.float32)


def soak(wet: Image, ink_load: float | Image, px_per_mm: float, rng: np.random.Generator) -> Image:
    """Ink taken up, (h, w) in 0 .. 1: fibres decide at the edge and, when the brush is dry, everywhere.

    `ink_load` is one number, or for a drag the load of the brush when it passed each pixel.
    """
    texture = _paper(wet.shape, px_per_mm, rng)
    # a drier brush wets only the peaks of the paper
    need = (3.5 + 6.0 * (1.0 - ink_load) ** 2) * np.exp((0.2 + 0.9 * (1.0 - ink_load)) * texture)
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
