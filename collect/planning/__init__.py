"""Walks a protocol without moving: poses, sheets, dips, ink, time, and a picture of where everything lies."""
