"""Maths of the stroke models: closed-form shapes and exact rasters on torch tensors, without I/O."""
