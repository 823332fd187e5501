"""Maths of the stroke models: closed-form shapes and exact rasters, without I/O.

Used by `calibrate`, the twin and the engine's pictures; imports no other folder, and only the generator's training
imports torch.
"""
