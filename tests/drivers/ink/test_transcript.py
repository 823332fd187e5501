"""The helper itself: a transcript that is not followed must fail."""

from __future__ import annotations

import pytest

from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.ink.port import SerialPort


async def ask(path: str, request: bytes) -> bytes:
    port = SerialPort("test", path, 9600)
    await port.open()
    try:
        return await port.exchange("ask", request, lambda received: received or None, timeout_s=0.1)
    finally:
        await port.close()


async def ask_twice(path: str) -> None:
    await ask(path, b"a")
    with pytest.raises(DeviceTimeout):
        await ask(path, b"a")


async def test_what_is_left_unsent_fails(expected_protocol):
    with (
        pytest.raises(AssertionError, match="never asked for"),
        expected_protocol([(b"a", b"b"), (b"c", b"d")]) as path,
    ):
        assert await ask(path, b"a") == b"b"


async def test_another_request_fails(expected_protocol):
    with pytest.raises(AssertionError, match="expected b'a', got b'x'"), expected_protocol([(b"a", b"b")]) as path:
        await ask(path, b"x")


async def test_one_request_too_many_fails(expected_protocol):
    with pytest.raises(AssertionError, match="nobody expected b'a'"), expected_protocol([(b"a", b"b")]) as path:
        await ask_twice(path)
