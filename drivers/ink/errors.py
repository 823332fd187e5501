"""What an ink device answers when it will not do as asked."""

from __future__ import annotations

from drivers.errors import DeviceError


class InkRefused(DeviceError):
    """The device understood the request and refused it; `code` is its own number for the reason."""

    def __init__(self, device: str, op: str, code: int, text: str, *, condition: str = "", remedy: str = "") -> None:
        self.code = code
        super().__init__(device, op, f"refused with {code} ({text})", condition=condition, remedy=remedy)
