"""Protocols: what `protocol.toml` may ask for, one module a kind."""
