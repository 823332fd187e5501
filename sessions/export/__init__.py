"""Recordings for other tools: images with tables, NumPy, Parquet."""
