"""Checking sessions for damage, and repairing them."""
