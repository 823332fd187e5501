"""Pictures of few colours as sixels: escape sequences that draw pixels on some terminals."""

from __future__ import annotations

import contextlib
import fcntl
import struct
import sys
import termios
from collections.abc import Sequence
from typing import TYPE_CHECKING

from textual.geometry import Size

from collect.tui.levels import RGB, Coloured, fitted, grays, runs, sampled

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

SIXEL_LEVELS = 16
"""Grays of a sixel picture: each is drawn by a pass of its own."""
BAND_PX = 6
NOTHING = -1
"""Level of a pixel that is not drawn."""
VT340_CELL_PX = (10, 20)


def lines_of(
    image: NDArray[np.uint8] | Coloured | None, size: Size, cell_px: tuple[int, int] = VT340_CELL_PX
) -> list[NDArray[np.int64]]:
    """The picture's colour numbers, cut into one array for each line of the terminal, as high as a cell.

    `NOTHING` fills the last line below the picture.
    """
    pixels = image.pixels if isinstance(image, Coloured) else image
    if pixels is None or not pixels.size or not size.area:
        return []
    import numpy as np

    width, height = size.width * cell_px[0], size.height * cell_px[1]
    coloured = isinstance(image, Coloured)
    levels = sampled(pixels, width, height) if coloured else fitted(pixels, width, height, SIXEL_LEVELS)
    rows, columns = levels.shape
    ground = np.full((-(-rows // cell_px[1]) * cell_px[1], columns), NOTHING)
    ground[:rows] = levels
    return [ground[y : y + cell_px[1]] for y in range(0, len(ground), cell_px[1])]


SIXEL_GRAYS = grays(SIXEL_LEVELS)


def sixels(levels: NDArray[np.int64], colours: Sequence[RGB] = SIXEL_GRAYS) -> str:
    """The escape sequence that draws (h, w) numbers of colours and leaves pixels that are `NOTHING` as they were.

    DEC STD 070, chapter 9: six rows a band, one pass a colour, runs as `!count`.
    """
    import numpy as np

    height, width = levels.shape
    used = [int(level) for level in np.unique(levels) if level != NOTHING]
    out = ["\x1bP0;1;0q", f'"1;1;{width};{height}']
    for number in used:
        out.append(f"#{number};2;" + ";".join(str(round(100 * part / 255)) for part in colours[number]))
    for top in range(0, height, BAND_PX):
        band = levels[top : top + BAND_PX]
        weights = 1 << np.arange(len(band))
        for level in np.unique(band):
            if level != NOTHING:
                signs = [(chr(63 + column), n) for column, n in runs(weights @ (band == level))]
                out.append(f"#{level}{''.join(f'!{n}{c}' if n > 3 else c * n for c, n in signs)}$")
        out.append("-")
    return "".join([*out, "\x1b\\"])


def terminal_cell_px() -> tuple[int, int] | None:
    """Width and height of a cell of this terminal; None if the terminal does not report them."""
    answer = bytes(8)
    if sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):
            answer = fcntl.ioctl(sys.__stderr__.fileno(), termios.TIOCGWINSZ, answer)
    rows, columns, width_px, height_px = struct.unpack("HHHH", answer)
    if not (rows and columns and width_px and height_px):
        return None
    return max(1, width_px // columns), max(1, height_px // rows)
