"""A stroke model fitted to the presses of one brush (`brushloop fit`).

Used by `recover`, `validate`, the loop and the twin, which read the fit in use from the session's folder.
"""
