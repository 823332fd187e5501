"""Characters: planned, compared with what was written, learned from."""
