"""From a photograph to one stroke: light, rectification, components, binarisation, measurement.

Here: the raster that strokes are measured on, and the parameters of the preprocessing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Soft = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
PX_PER_MM = 20.0
"""Resolution of the raster that strokes are measured on (0.05 mm a pixel)."""


@dataclass(frozen=True, slots=True)
class Params:
    """Parameters of the preprocessing."""

    background_mm: float = 32.0
    """Window for estimating the lighting; a stroke thicker than this would be mistaken for shadow."""
    contrast_gate: float = 0.25
    """Least contrast of the darkest ink; below it the capture is blank, and Otsu would call paper ink."""
    speck_share: float = 0.01
    """Components below this share of the main one are specks."""
    join_mm: float = 1.5
    """Components farther than this from the main one belong to other strokes."""
