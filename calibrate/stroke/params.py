"""The raster that strokes are measured on, and the named parameters of how they get there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]
Soft = NDArray[np.float32]
Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
PX_PER_MM = 20.0
"""The raster that strokes are measured on (0.05 mm a pixel)."""


@dataclass(frozen=True, slots=True)
class Params:
    """Named parameters of the preprocessing; they go into the calibration's artefact."""

    background_mm: float = 32.0
    """Size of the window that follows the light; a stroke thicker than this would be taken for shadow."""
    contrast_gate: float = 0.25
    """Darkest ink must lie this far below paper, else the capture is blank: Otsu would call paper ink."""
    speck_share: float = 0.01
    """Components below this share of the main one are specks."""
    join_mm: float = 1.5
    """Components farther than this from the main one belong to other strokes."""
    hole_mm2: float = 0.0
    """Holes in the stroke up to this area are filled, as glare on wet ink leaves them; 0 keeps them: dry ink has
    holes too."""
