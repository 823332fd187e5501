"""What can be asked for: the kinds of protocol, their strokes and their steps.

Read from `protocol.toml` by `config`; plan, engine and screens walk the same steps. Knows no device.
"""
