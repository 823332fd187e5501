"""Pictures reduced to few colours and fitted into a place, whatever draws them then."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

RGB = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Coloured:
    """A picture whose (h, w) pixels are numbers of a few colours."""

    pixels: NDArray[np.uint8]
    colours: tuple[RGB, ...]


def grays(levels: int) -> tuple[RGB, ...]:
    """This many grays from black to white."""
    return tuple((gray, gray, gray) for gray in (round(255 * k / (levels - 1)) for k in range(levels)))


STEADY = 0.8
"""A level is kept while the picture stays within this many levels of it: most changes of a camera are noise."""


def fitted(
    image: NDArray[np.uint8],
    width: int,
    height: int,
    levels: int,
    step: int = 1,
    before: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Scale the (h, w) gray picture into `width` x `height`, its shape kept, in grays 0 to `levels` - 1.

    The rows of the result are a multiple of `step`, and at least one. Levels of the picture `before` that are still
    right within `STEADY` stay.
    """
    import cv2
    import numpy as np

    scale = min(width / image.shape[1], height / image.shape[0])
    columns, rows = max(1, int(image.shape[1] * scale)), max(1, int(image.shape[0] * scale / step)) * step
    small = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), np.int64) * (levels - 1)
    made = (small + 127) // 255
    if before is None or before.shape != made.shape:
        return made
    return np.where(np.abs(small - 255 * before) < 255 * STEADY, before, made)


def runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
    """(value, count) of each run of equal values."""
    import numpy as np

    starts = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    counts = np.diff(np.append(starts, len(values)))
    return list(zip(values[starts].tolist(), counts.tolist(), strict=True))


def sampled(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.int64]:
    """Scale numbers of colours into `width` x `height` without mixing them, the shape kept."""
    import cv2
    import numpy as np

    scale = min(width / pixels.shape[1], height / pixels.shape[0])
    size = max(1, int(pixels.shape[1] * scale)), max(1, int(pixels.shape[0] * scale))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST), np.int64)
