"""Walks a protocol without moving: poses, sheets, dips, ink, time, and a picture of where everything lies.

Used by `collect plan`, before every run, and by the engine, which checks again once the paper was touched.
"""
