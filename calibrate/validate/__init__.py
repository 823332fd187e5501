"""Validation at any scale: every model against every captured press, and what comes out of it."""
