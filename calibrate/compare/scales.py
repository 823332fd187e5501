"""Scales at which strokes are shown and compared; a module that loads nothing, as commands name them as defaults."""

from __future__ import annotations

MM_PER_PX = 0.3
"""Of the 128 x 128 field of a press, wherever one is shown, fitted, compared or inverted. 38.4 mm hold an anchored
stroke of any cell of the grid; 0.2 mm/px would not."""
DRAG_MM_PER_PX = 0.6
"""Of the images that strokes that travel are fitted to."""
