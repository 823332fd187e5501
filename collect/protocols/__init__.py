"""Protocols: what `protocol.toml` may ask for, and the steps that it becomes."""
