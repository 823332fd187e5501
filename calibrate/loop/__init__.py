"""Strokes recovered from their images and pressed again, compared with the originals."""
