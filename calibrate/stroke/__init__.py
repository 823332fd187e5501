"""One stroke out of a photograph: the paper's preprocessing, and the stroke that is new since another photograph.

Used by everything that reads presses, and by the checks of a run; works on arrays alone.
"""
