"""File operations off the event loop that a stop does not cut in half."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

_R = TypeVar("_R")


async def uninterrupted(function: Callable[..., _R], *args: object) -> _R:
    """Run in a thread; a cancellation is passed on only once the function has returned.

    Half of a file operation is worse than one that ends a few milliseconds after the stop key.
    """
    task = asyncio.ensure_future(asyncio.to_thread(function, *args))
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await task
        raise
