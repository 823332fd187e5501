"""The app that a widget is in, with its type."""

from __future__ import annotations

from typing import cast

from textual.app import App
from textual.dom import DOMNode


def host(node: DOMNode) -> App[None]:
    """textual does not say which app it is."""
    return cast("App[None]", node.app)  # pyright: ignore[reportUnknownMemberType]
