"""Strokes that travel along the paper: their ink measured, and bristle lag fitted to it."""
