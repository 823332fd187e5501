"""Characters: strokes of a font or a hand to trajectories of the brush, and trajectories to an image.

Used by `calibrate.writing` alone.
"""
