"""The loopback camera's optics: perspective, radial distortion, uneven light and a shadow, all known exactly."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.config import View

Floats = NDArray[np.float64]
SHADOW_SOFTNESS = 0.02
"""Width of the shadow's edge, as a share of the image."""


class Optics:
    """From the paper plane to pixels, and from even light to what falls on the sheet."""

    def __init__(self, view: View, seed: int) -> None:
        self.homography = homography(view)
        self.light = _light(view, np.random.default_rng([seed, 11]))
        self.glare = _glare(view, self.homography) if view.glare else None
        f, cx, cy = float(view.width_px), (view.width_px - 1) / 2, (view.height_px - 1) / 2
        self.camera_matrix: Floats = np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])
        self.distortion: Floats = np.array([view.k1, 0.0, 0.0, 0.0])
        self._map = self._straight_places(view) if view.k1 else None

    def image_of(self, paper_mm: Floats) -> Floats:
        """(n, 2) pixels (centres on integers) of (n, 2) points of the paper plane, distortion included."""
        mapped = np.column_stack([paper_mm, np.ones(len(paper_mm))]) @ self.homography.T
        straight = mapped[:, :2] / mapped[:, 2:]
        rays = np.column_stack([straight, np.ones(len(straight))]) @ np.linalg.inv(self.camera_matrix).T
        none = np.zeros(3)
        bent, _ = cv2.projectPoints(rays[:, None], none, none, self.camera_matrix, self.distortion)
        return np.asarray(bent, np.float64).reshape(-1, 2)

    def distort(self, straight: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image as this lens would have taken it; the same where the lens is perfect."""
        if self._map is None:
            return straight
        bent = cv2.remap(straight, self._map, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cast("NDArray[np.uint8]", bent)

    def _straight_places(self, view: View) -> NDArray[np.float32]:
        """(h, w, 2): for every pixel of the bent image, its place in the straight one."""
        columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        places = cv2.undistortPoints(pixels, self.camera_matrix, self.distortion, P=self.camera_matrix)
        return places.reshape(view.height_px, view.width_px, 2).astype(np.float32)


def homography(view: View) -> NDArray[np.float64]:
    """(3, 3) from the paper plane in mm to image pixels, pixel centres on integers; rows run against y."""
    turn = math.radians(view.turn_deg)
    cos, sin, s = math.cos(turn), math.sin(turn), view.px_per_mm
    x, y = view.centre_mm
    to_centre = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 1.0]])
    flat = np.array([[s * cos, -s * sin, 0.0], [-s * sin, -s * cos, 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, view.keystone / view.height_px, 1.0]])
    to_image = np.array([[1.0, 0.0, view.width_px / 2], [0.0, 1.0, view.height_px / 2], [0.0, 0.0, 1.0]])
    return to_image @ tilt @ flat @ to_centre


def _light(view: View, rng: np.random.Generator) -> NDArray[np.float32]:
    x = np.linspace(0.0, 1.0, view.width_px, dtype=np.float32)
    y = np.linspace(0.0, 1.0, view.height_px, dtype=np.float32)[:, None]
    slope = 1.0 - view.shade * (0.6 * x + 0.4 * y) ** 2
    across = math.cos(angle := rng.uniform(0.0, 2.0 * math.pi)) * (x - 0.5) + math.sin(angle) * (y - 0.5)
    edge = rng.uniform(-0.1, 0.1)
    in_shadow = 1.0 / (1.0 + np.exp(-(across - edge) / SHADOW_SOFTNESS))
    return (slope * (1.0 - view.shadow * in_shadow)).astype(np.float32)


def _glare(view: View, paper_to_image: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gray levels (h, w) that a lamp's reflection adds; it is far larger than what the lens could bend."""
    u, v, scale = paper_to_image @ np.array([*view.glare_mm, 1.0])
    x, y = np.arange(view.width_px) - u / scale, np.arange(view.height_px)[:, None] - v / scale
    sigma_px = view.glare_sigma_mm * view.px_per_mm
    return (view.glare * np.exp(-0.5 * (x**2 + y**2) / sigma_px**2)).astype(np.float32)
