"""CRC-16/MODBUS, shared by Modbus RTU and the ink station's lines."""

from __future__ import annotations

_POLYNOMIAL = 0xA001  # 0x8005, reflected


def crc16(data: bytes) -> int:
    """CRC-16/MODBUS of `data`: 0x4B37 for b"123456789"."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (_POLYNOMIAL if crc & 1 else 0)
    return crc
