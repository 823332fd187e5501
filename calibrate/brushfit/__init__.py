"""Fits a stroke model to a brush's own strokes: presses and drags, with intervals and held-out scores."""
