"""The sheet: ink on a raster, laid down footprint by footprint."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.sim.brush.brush import Footprint

PX_PER_MM = 10.0


class Paper:
    """Ink per area on a sheet of (width, height) mm; row 0 is the far edge (largest y), as a camera sees it."""

    def __init__(self, width_mm: float, height_mm: float) -> None:
        self.width_mm = width_mm
        self.height_mm = height_mm
        shape = (round(height_mm * PX_PER_MM), round(width_mm * PX_PER_MM))
        self._density: NDArray[np.float32] = np.zeros(shape, np.float32)
        self._coming: deque[tuple[Callable[[], Footprint], float, float, float]] = deque()
        self._lock = threading.Lock()
        self.presses = 0

    @property
    def density(self) -> NDArray[np.float32]:
        """Ink per area, (rows, columns), 0 to 1, with every mark that was announced."""
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
        """Lay what `make` returns before anybody next looks at the sheet, in whatever thread looks.

        A footprint takes a tenth of a second to work out; whoever moves the arm has no such time.
        """
        self.presses += 1
        self._coming.append((make, x_mm, y_mm, heading_deg))

    def lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        """Lay a footprint with its zero-touch point at (x, y) and its +x along the heading; ink only adds up."""
        self.lay_later(lambda: footprint, x_mm, y_mm, heading_deg)

    def _lay(self, footprint: Footprint, x_mm: float, y_mm: float, heading_deg: float) -> None:
        scale = PX_PER_MM / footprint.px_per_mm
        phi = math.radians(heading_deg)
        cos, sin = scale * math.cos(phi), scale * math.sin(phi)
        # Rows run against y, so a counter-clockwise heading is clockwise in row and column.
        linear = np.array([[cos, sin], [-sin, cos]])
        anchor = np.array([x_mm * PX_PER_MM, (self.height_mm - y_mm) * PX_PER_MM])
        # cv2 puts pixel centres on integers, our coordinates put them on halves.
        half = np.array([0.5, 0.5])
        offset = anchor - linear @ (np.array(footprint.origin_px) - half) - half
        rows, columns = self._density.shape
        laid = cv2.warpAffine(
            footprint.density,
            np.column_stack([linear, offset]),
            (columns, rows),
            flags=cv2.INTER_LINEAR if scale >= 0.5 else cv2.INTER_AREA,
        )
        self._density = (1.0 - (1.0 - self._density) * (1.0 - np.clip(laid, 0.0, 1.0))).astype(np.float32)
