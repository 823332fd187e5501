"""Photographs of the sheet that are known to be fresh.

Used by `motion`, which parks the arm for each, and by the first day; looks at frames, and moves nothing by itself.
"""
