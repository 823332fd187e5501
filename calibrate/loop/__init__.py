"""Strokes pressed again from what their images told, beside the originals."""
