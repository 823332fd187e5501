"""Photographs of the sheet that are known to be fresh, and the ink that came between two of them."""
