"""Finds the paper by touch, and checks the rig by three marks.

Used by the engine's steps; moves the arm only through `motion`.
"""
