"""Exports of recordings for other tools: images with tables, NumPy, Parquet."""
