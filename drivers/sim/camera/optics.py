"""The loopback camera's optics: the projection of the paper plane to pixels, and the uneven light on the sheet."""

from __future__ import annotations

import math
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.sim.config import View

Floats = NDArray[np.float64]
SHADOW_SOFTNESS = 0.02
"""Width of the shadow's edge, as a share of the image."""


class Optics:
    """Projection of the paper plane to pixels, and the uneven light on the sheet."""

    def __init__(self, view: View, seed: int) -> None:
        self.homography = homography(view)
        self.light = _light(view, np.random.default_rng([seed, 11]))
        self.glare = _glare(view, self.homography) if view.glare else None
        self.camera_matrix = camera_matrix(view)
        self.distortion: Floats = np.array([view.k1, 0.0, 0.0, 0.0])
        self._map = self._undistorted_places(view) if view.k1 else None

    def image_of(self, paper_mm: Floats) -> Floats:
        """(n, 2) pixels (centres on integers) of (n, 2) points of the paper plane, distortion included."""
        undistorted = self.undistorted_image_of(paper_mm)
        rays = np.column_stack([undistorted, np.ones(len(undistorted))]) @ np.linalg.inv(self.camera_matrix).T
        none = np.zeros(3)
        distorted, _ = cv2.projectPoints(rays[:, None], none, none, self.camera_matrix, self.distortion)
        return np.asarray(distorted, np.float64).reshape(-1, 2)

    def undistorted_image_of(self, paper_mm: Floats) -> Floats:
        """The same as `image_of`, for a lens without distortion."""
        mapped = np.column_stack([paper_mm, np.ones(len(paper_mm))]) @ self.homography.T
        return np.asarray(mapped[:, :2] / mapped[:, 2:], np.float64)

    def distort(self, undistorted: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image as this lens would have taken it; the same if the lens is perfect."""
        if self._map is None:
            return undistorted
        distorted = cv2.remap(undistorted, self._map, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cast("NDArray[np.uint8]", distorted)

    def _undistorted_places(self, view: View) -> NDArray[np.float32]:
        """(h, w, 2): for every pixel of the distorted image, its place in the undistorted one."""
        columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        places = cv2.undistortPoints(pixels, self.camera_matrix, self.distortion, P=self.camera_matrix)
        return places.reshape(view.height_px, view.width_px, 2).astype(np.float32)


def camera_matrix(view: View) -> Floats:
    """(3, 3) of the pinhole, in pixels; its principal point is the middle of the image."""
    f, cx, cy = view.focal * view.width_px, (view.width_px - 1) / 2, (view.height_px - 1) / 2
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def stance(view: View, lens_mm: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """(rotation (3, 3), translation (3,) in mm) from the paper frame to that of a camera at `lens_mm`.

    The camera looks at the middle of the view; without a turn its x axis lies over the paper's.
    """
    aim = np.array([*view.centre_mm, 0.0]) - lens_mm
    ahead = aim / np.linalg.norm(aim)
    across = np.array([1.0, 0.0, 0.0]) - ahead[0] * ahead
    across = across / np.linalg.norm(across)
    turn = math.radians(view.turn_deg)
    right = math.cos(turn) * across - math.sin(turn) * np.cross(ahead, across)
    rotation = np.asarray(np.stack([right, np.cross(ahead, right), ahead]), np.float64)
    return rotation, np.asarray(-rotation @ np.array(lens_mm), np.float64)


def homography(view: View) -> NDArray[np.float64]:
    """(3, 3) from the paper plane in mm to image pixels, pixel centres on integers; rows run against y."""
    if view.lens_mm is not None:
        rotation, shift = stance(view, view.lens_mm)
        return camera_matrix(view) @ np.column_stack([rotation[:, 0], rotation[:, 1], shift])
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
    """Gray levels (h, w) that a lamp's reflection adds; the lens's distortion of it is left out."""
    u, v, scale = paper_to_image @ np.array([*view.glare_mm, 1.0])
    x, y = np.arange(view.width_px) - u / scale, np.arange(view.height_px)[:, None] - v / scale
    sigma_px = view.glare_sigma_mm * view.px_per_mm
    return (view.glare * np.exp(-0.5 * (x**2 + y**2) / sigma_px**2)).astype(np.float32)
