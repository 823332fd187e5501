"""Ink stations on a serial line: one with a documented line protocol, and a peristaltic pump on Modbus RTU."""
