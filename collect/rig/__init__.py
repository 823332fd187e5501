"""The rig: its configuration, its devices, the paper on its table, and a check that every device answers.

Used by all of `collect`; `devices` alone makes drivers, and nothing here moves the arm.
"""
