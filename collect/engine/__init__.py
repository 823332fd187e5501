"""Runs a protocol on a rig, one step at a time, so that every stroke is pressed exactly once."""
