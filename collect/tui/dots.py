"""Pictures in braille cells: eight dots and two colours each, four times the detail of half-cells, and still text.

The ground of a cell has the colour of most of its pixels; the dots are the others.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from rich.segment import Segment
from rich.style import Style
from textual.geometry import Size
from textual.strip import Strip

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEVELS = 32
"""Grays of a picture: fewer styles make longer runs, less to send over a slow line."""
FLAT = 3
"""Grays by which the pixels of a cell may differ without being drawn as dots: noise of the paper and of the camera."""
EMPTY = 0x2800
"""The braille pattern without dots; its 256 patterns follow each other."""
STEADY = 0.8
"""A level is kept while the picture stays within this many levels of it: most changes of a camera are noise."""
ROWS, COLUMNS = 4, 2
BITS = (0x01, 0x08, 0x02, 0x10, 0x04, 0x20, 0x40, 0x80)
"""The bit of each dot, row by row."""
RGB = tuple[int, int, int]
GRAYS: list[RGB] = [(gray, gray, gray) for gray in (round(255 * level / (LEVELS - 1)) for level in range(LEVELS))]


class Cells:
    """A picture fitted into this many cells of the terminal."""

    def __init__(self, image: NDArray[np.uint8] | None, size: Size, before: Cells | None = None) -> None:
        """`image` is gray, (h, w), or in few colours, (h, w, 3) RGB. `before` is the picture before, of which the grays
        stay that are still right; see `_fitted`."""
        self.codes: NDArray[np.int64] | None = None
        """(lines, columns): 256 * (number of the pair of colours) + dots; None without a picture or a place for it."""
        self._levels: NDArray[np.int64] | None = None
        self._colours = GRAYS
        if image is None or not image.size or size.width < 1 or size.height < 1:
            return
        width, height = COLUMNS * size.width, ROWS * size.height
        if image.ndim == 3:
            numbers, self._colours = _sampled(image, width, height)
            dots, ground, other = _by_colour(_blocks(numbers), len(self._colours))
        else:
            self._levels = _fitted(image, width, height, None if before is None else before._levels)
            dots, ground, other = _by_gray(_blocks(self._levels))
        self.codes = (other * len(self._colours) + ground) * 256 + dots

    def strip(self, y: int) -> Strip:
        """One line of the terminal."""
        assert self.codes is not None
        line = self.codes[y]
        out: list[Segment] = []
        at = 0
        for pair, count in _runs(line >> 8):
            other, ground = divmod(pair, len(self._colours))
            text = "".join(chr(EMPTY + dots) for dots in (line[at : at + count] & 255).tolist())
            out.append(Segment(text, _style(self._colours[other], self._colours[ground])))
            at += count
        return Strip(out, len(line))


def _fitted(image: NDArray[np.uint8], width: int, height: int, before: NDArray[np.int64] | None) -> NDArray[np.int64]:
    """Scale the (h, w) gray picture into `width` x `height`, its shape kept, in grays 0 to `LEVELS` - 1.

    The rows of the result are a multiple of `ROWS`. Levels of the picture `before` that are still right within `STEADY`
    stay.
    """
    import cv2
    import numpy as np

    scale = min(width / image.shape[1], height / image.shape[0])
    columns, rows = max(1, int(image.shape[1] * scale)), max(1, int(image.shape[0] * scale / ROWS)) * ROWS
    small = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), np.int64) * (LEVELS - 1)
    made = (small + 127) // 255
    if before is None or before.shape != made.shape:
        return made
    return np.where(np.abs(small - 255 * before) < 255 * STEADY, before, made)


def _runs(values: NDArray[np.int64]) -> list[tuple[int, int]]:
    """(value, count) of each run of equal values."""
    import numpy as np

    starts = np.flatnonzero(np.concatenate(([True], values[1:] != values[:-1])))
    counts = np.diff(np.append(starts, len(values)))
    return list(zip(values[starts].tolist(), counts.tolist(), strict=True))


def _sampled(pixels: NDArray[np.uint8], width: int, height: int) -> tuple[NDArray[np.int64], list[RGB]]:
    """Scale a picture in few colours into `width` x `height` without mixing them, the shape kept.

    Returns the number of each pixel's colour, and the colours.
    """
    import cv2
    import numpy as np

    scale = min(width / pixels.shape[1], height / pixels.shape[0])
    size = max(1, int(pixels.shape[1] * scale)), max(1, int(pixels.shape[0] * scale))
    small = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST))
    colours, numbers = np.unique(small.reshape(-1, 3), axis=0, return_inverse=True)
    return np.asarray(numbers.reshape(small.shape[:2]), np.int64), [(r, g, b) for r, g, b in colours.tolist()]


def _blocks(pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """The pixels of each cell, (lines, columns, 8); an edge that fills no cell is continued."""
    import numpy as np

    rows, columns = pixels.shape
    whole = np.pad(pixels, ((0, -rows % ROWS), (0, -columns % COLUMNS)), mode="edge")
    lines, across = whole.shape[0] // ROWS, whole.shape[1] // COLUMNS
    parts = whole.reshape(lines, ROWS, across, COLUMNS).swapaxes(1, 2)
    return parts.reshape(lines, across, ROWS * COLUMNS)


def _by_gray(blocks: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
    """Dots, ground and colour of the dots: the pixels on either side of the middle gray, each by its mean."""
    import numpy as np

    low, high = blocks.min(-1), blocks.max(-1)
    dark = 2 * blocks < (low + high)[..., None]
    dark &= (high - low >= FLAT)[..., None]
    count = dark.sum(-1)
    bright_mean = _rounded((blocks * ~dark).sum(-1), 8 - count)
    dark_mean = np.where(count > 0, _rounded((blocks * dark).sum(-1), np.maximum(count, 1)), bright_mean)
    mostly_dark = count > ROWS * COLUMNS // 2
    dots = (dark ^ mostly_dark[..., None]) @ np.array(BITS)
    return dots, np.where(mostly_dark, dark_mean, bright_mean), np.where(mostly_dark, bright_mean, dark_mean)


def _by_colour(blocks: NDArray[np.int64], colours: int) -> tuple[NDArray[np.int64], ...]:
    """Dots, ground and colour of the dots: the commonest colour, and the next."""
    import numpy as np

    counts = np.asarray((blocks[..., None] == np.arange(colours)).sum(-2), np.int64)
    ground = np.asarray(counts.argmax(-1), np.int64)
    np.put_along_axis(counts, ground[..., None], 0, -1)
    other = np.asarray(np.where(counts.any(-1), counts.argmax(-1), ground), np.int64)
    return (blocks != ground[..., None]) @ np.array(BITS), ground, other


def _rounded(total: NDArray[np.int64], count: NDArray[np.int64]) -> NDArray[np.int64]:
    return (2 * total + count) // (2 * count)


@lru_cache(maxsize=LEVELS * LEVELS)
def _style(dots: RGB, ground: RGB) -> Style:
    return Style.parse(f"rgb({dots[0]},{dots[1]},{dots[2]}) on rgb({ground[0]},{ground[1]},{ground[2]})")
