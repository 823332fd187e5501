"""Lists of numbers off the wire."""

from __future__ import annotations

import math


def numbers(values: object, count: int) -> list[float]:
    """`values` as floats. Raises ValueError unless it is a list of `count` finite numbers.

    JSON knows integers that no float holds, and a text of six digits is no pose.
    """
    if not isinstance(values, list):
        raise ValueError(f"expected {count} numbers, got {str(values)[:80]!r}")
    try:
        found = [float(v) if type(v) in (int, float) else math.nan for v in values]  # pyright: ignore[reportUnknownVariableType, reportUnknownArgumentType]
    except OverflowError:
        found = []
    if len(found) != count or not all(map(math.isfinite, found)):
        raise ValueError(f"expected {count} finite numbers, got {str(values)[:80]}")  # pyright: ignore[reportUnknownArgumentType]
    return found
