"""Gray pictures reduced to few levels, as runs, and as sixels: escape sequences that draw pixels on some terminals."""

from __future__ import annotations

import contextlib
import fcntl
import struct
import sys
import termios
from typing import TYPE_CHECKING

from textual.geometry import Size

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SIXEL_LEVELS = 16
"""Grays of a sixel picture: each is drawn by a pass of its own."""
BAND_PX = 6
NOTHING = -1
"""Level of a pixel that is not drawn."""
VT340_CELL_PX = (10, 20)


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


def lines_of(
    image: NDArray[np.uint8] | None, size: Size, cell_px: tuple[int, int] = VT340_CELL_PX
) -> list[NDArray[np.int64]]:
    """Gray levels of a picture cut into lines of the terminal, one array as high as a cell for each line it reaches.

    `NOTHING` fills the last line below the picture.
    """
    if image is None or not image.size or not size.area:
        return []
    import numpy as np

    levels = fitted(image, size.width * cell_px[0], size.height * cell_px[1], SIXEL_LEVELS)
    rows, columns = levels.shape
    ground = np.full((-(-rows // cell_px[1]) * cell_px[1], columns), NOTHING)
    ground[:rows] = levels
    return [ground[y : y + cell_px[1]] for y in range(0, len(ground), cell_px[1])]


def sixels(levels: NDArray[np.int64]) -> str:
    """The escape sequence that draws (h, w) gray levels and leaves pixels that are `NOTHING` as they were.

    DEC STD 070, chapter 9: six rows a band, one pass a colour, runs as `!count`.
    """
    import numpy as np

    height, width = levels.shape
    used = [int(level) for level in np.unique(levels) if level != NOTHING]
    percent = {level: round(100 * level / (SIXEL_LEVELS - 1)) for level in used}
    out = ["\x1bP0;1;0q", f'"1;1;{width};{height}', *(f"#{k};2;{p};{p};{p}" for k, p in percent.items())]
    for top in range(0, height, BAND_PX):
        band = levels[top : top + BAND_PX]
        weights = 1 << np.arange(len(band))
        for level in np.unique(band):
            if level != NOTHING:
                signs = [(chr(63 + column), n) for column, n in runs(weights @ (band == level))]
                out.append(f"#{level}{''.join(f'!{n}{c}' if n > 3 else c * n for c, n in signs)}$")
        out.append("-")
    return "".join([*out, "\x1b\\"])


def terminal_cell_px() -> tuple[int, int]:
    """Width and height of a cell of this terminal; a VT340's if the terminal does not report them."""
    answer = bytes(8)
    if sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):
            answer = fcntl.ioctl(sys.__stderr__.fileno(), termios.TIOCGWINSZ, answer)
    rows, columns, width_px, height_px = struct.unpack("HHHH", answer)
    if not (rows and columns and width_px and height_px):
        return VT340_CELL_PX
    return max(1, width_px // columns), max(1, height_px // rows)
