"""Validation: every model compared with every captured press, and the report."""
