"""A lens: remove its distortion from pixels and photographs, and add it again (OpenCV's five-parameter model)."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.errors import CalibrationError

Gray = NDArray[np.uint8]
Floats = NDArray[np.float64]
ROUNDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)


class Lens(Frozen):
    """Camera matrix and distortion of one camera at one focus and one image size, in files as in calculations."""

    source: str = ""
    """`lens file <hash>`, or `k1 fitted on the board` where no lens file was given and none was needed."""
    size_px: tuple[int, int]
    """Width and height of the photographs that it applies to."""
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy in pixels, pixel centres on integers."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3 of OpenCV's model."""

    @classmethod
    def of_opencv(cls, camera: ArrayLike, distortion: ArrayLike, size_px: tuple[int, int]) -> Lens:
        """A lens from OpenCV's (3, 3) camera matrix and its coefficients, of which the first five count."""
        m = np.asarray(camera, np.float64)
        k1, k2, p1, p2, k3 = np.asarray(distortion, np.float64).ravel()[:5].tolist()
        matrix = (float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2]))
        return cls(size_px=size_px, matrix=matrix, distortion=(k1, k2, p1, p2, k3))

    @property
    def camera(self) -> Floats:
        """OpenCV's camera matrix, (3, 3)."""
        fx, fy, cx, cy = self.matrix
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> Floats:
        """OpenCV's distortion coefficients, (5,)."""
        return np.array(self.distortion)

    def check_size(self, image: Gray, where: str) -> None:
        """Raise `CalibrationError` for an (h, w) photograph of another size: the lens does not apply to it."""
        size_px = (image.shape[1], image.shape[0])
        if size_px != self.size_px:
            is_px, was_px = (f"{width} x {height} px" for width, height in (size_px, self.size_px))
            raise CalibrationError(where, f"is {is_px}, the lens was calibrated at {was_px}")

    def undistorted(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of a photograph -> where they lie in the undistorted one."""
        points, camera = pixels.reshape(-1, 1, 2).astype(np.float64), self.camera
        flat = cv2.undistortPointsIter(points, camera, self.coefficients, np.eye(3), camera, ROUNDS)
        return np.asarray(flat, np.float64).reshape(-1, 2)

    def distorted(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of the undistorted photograph -> where they lie in the photograph as it was taken."""
        focal, centre = np.array(self.matrix[:2]), np.array(self.matrix[2:])
        return distort((pixels - centre) / focal, self.coefficients) * focal + centre

    def undistort(self, image: Gray) -> Gray:
        """The photograph as a lens without distortion would have taken it, same size and camera matrix."""
        return cast("Gray", cv2.undistort(image, self.camera, self.coefficients))


def distort(rays: Floats, distortion: Floats) -> Floats:
    """Distort (n, 2) points at distance 1 by Brown's model as OpenCV defines it; `distortion` is k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = distortion
    x, y = rays[:, 0], rays[:, 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    along = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.column_stack([across, along])


def rms(residuals: Floats) -> float:
    """Root mean square of the lengths of (n, 2) residuals."""
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))


def unknown_lens(size_px: tuple[int, int]) -> Lens:
    """Lens assumed without intrinsics: no distortion, axis in the middle, focal length of one image width."""
    width, height = size_px
    focal = float(max(size_px))
    matrix = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    return Lens(size_px=size_px, matrix=matrix, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))
