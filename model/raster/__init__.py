"""Outlines to images: exact and compiled, exact and differentiable, and soft."""
