"""Maths of the stroke models: closed-form shapes and exact rasters, without I/O."""
