"""The engine: runs a protocol on a rig, step by step, and makes each stroke exactly once.

Used by the commands, the screens and the first day's proof; the only part of collect that writes a session.
"""
