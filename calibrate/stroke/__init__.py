"""From a photograph to one stroke: light, rectification, components, binarisation, measurement.

Here: the raster that strokes are measured on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Soft = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
PX_PER_MM = 20.0
"""Resolution of the raster that strokes are measured on (0.05 mm a pixel)."""
