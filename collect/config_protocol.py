"""The grid under its old name; the protocols are in `collect.protocols.config`."""

from __future__ import annotations

from collect.protocols.config import GridConfig

__all__ = ["GridConfig"]
