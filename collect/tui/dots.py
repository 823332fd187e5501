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

from brushloop.collect.tui.levels import RGB, Coloured, fitted, grays, runs, sampled

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEVELS = 32
"""Grays of a picture: fewer styles make longer runs, less to send over a slow line."""
FLAT = 3
"""Grays by which the pixels of a cell may differ without being drawn as dots: noise of the paper and of the camera."""
EMPTY = 0x2800
"""The braille pattern without dots; its 256 patterns follow each other."""
ROWS, COLUMNS = 4, 2
BITS = (0x01, 0x08, 0x02, 0x10, 0x04, 0x20, 0x40, 0x80)
"""The bit of each dot, row by row."""
GRAYS = grays(LEVELS)


class Cells:
    """A picture fitted into this many cells of the terminal."""

    def __init__(self, image: NDArray[np.uint8] | Coloured | None, size: Size, before: Cells | None = None) -> None:
        """`before` is the picture before, of which the grays stay that are still right; see `fitted`."""
        self.codes: NDArray[np.int64] | None = None
        """(lines, columns): 256 * (number of the pair of colours) + dots; None without a picture or a place for it."""
        self._levels: NDArray[np.int64] | None = None
        self._colours = GRAYS
        pixels = image.pixels if isinstance(image, Coloured) else image
        if pixels is None or not pixels.size or size.width < 1 or size.height < 1:
            return
        width, height = COLUMNS * size.width, ROWS * size.height
        if isinstance(image, Coloured):
            self._colours = image.colours
            blocks = _blocks(sampled(image.pixels, width, height))
            dots, ground, other = _by_colour(blocks, len(image.colours))
        else:
            self._levels = fitted(pixels, width, height, LEVELS, ROWS, None if before is None else before._levels)
            dots, ground, other = _by_gray(_blocks(self._levels))
        self.codes = (other * len(self._colours) + ground) * 256 + dots

    def strip(self, y: int) -> Strip:
        """One line of the terminal."""
        assert self.codes is not None
        line = self.codes[y]
        out: list[Segment] = []
        at = 0
        for pair, count in runs(line >> 8):
            other, ground = divmod(pair, len(self._colours))
            text = "".join(chr(EMPTY + dots) for dots in (line[at : at + count] & 255).tolist())
            out.append(Segment(text, _style(self._colours[other], self._colours[ground])))
            at += count
        return Strip(out, len(line))


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
