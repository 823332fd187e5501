"""Ink stations on a serial line: one with a documented line protocol, and a peristaltic pump on Modbus RTU.

Used by `collect.rig.devices` and `collect.teach`; `simulator` by the loopback rig and tests alone.
"""
