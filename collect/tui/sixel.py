"""Gray pictures in pixels on a terminal that draws sixels, one image for each line of cells.

textual repaints lines, not pictures: an image over many lines would be drawn again at every change of one of them, and
where it reaches below the last line it scrolls the screen.
"""

from __future__ import annotations

import contextlib
import fcntl
import struct
import sys
import termios
from typing import TYPE_CHECKING

from rich.segment import ControlType, Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from collect.tui.gray import fitted, runs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEVELS = 16
"""Grays that are told apart: each is drawn by a pass of its own."""
BAND_PX = 6
NOTHING = -1
VT340_CELL_PX = (10, 20)


class SixelPicture(Container):
    """A picture in pixels, as large as its place allows, its shape kept.

    textual cuts and pads the lines of a widget that has a border, and drops the pixels: the border goes around them.
    """

    DEFAULT_CSS = """
    SixelPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._pixels = Pixels()

    def compose(self) -> ComposeResult:
        """The pixels."""
        yield self._pixels

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw another picture; the same object is not drawn twice."""
        self._pixels.show(image)


class Pixels(Widget):
    """The picture itself."""

    DEFAULT_CSS = """
    Pixels { width: 1fr; height: 1fr; }
    """

    def __init__(self) -> None:
        super().__init__()
        self._image: NDArray[np.uint8] | None = None
        self._lines: list[NDArray[np.int64]] = []
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw another picture; the same object is not drawn twice, nor is a line that did not change."""
        if image is self._image:
            return
        self._image = image
        before, size = self._lines, self.size
        self._lay()
        for y in range(size.height):
            old, new = (lines[y] if y < len(lines) else None for lines in (before, self._lines))
            if old is None or new is None or old.shape != new.shape or (old != new).any():
                self.refresh(Region(0, y, size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Blank cells, which erase what was there, and the pixels over them."""
        if self._made_for != self.size:
            self._lay()
        width, ground = self.size.width, self.rich_style
        # While something lies over the screen textual dims what is below, which pixels cannot be.
        if y >= len(self._lines) or not self.screen.is_active:
            return Strip.blank(width, ground)
        pixels = f"\x1b[{width}D\x1b7{sixels(self._lines[y])}\x1b8\x1b[{width}C"
        control = Segment(pixels, Style.null(), ((ControlType.CURSOR_FORWARD, 0),))
        return Strip([Segment(" " * width, ground), control], width)

    def _lay(self) -> None:
        self._made_for = self.size
        self._lines = lines_of(self._image, self.size, cell_px())


def lines_of(
    image: NDArray[np.uint8] | None, size: Size, cell: tuple[int, int] = VT340_CELL_PX
) -> list[NDArray[np.int64]]:
    """Gray levels, `NOTHING` beside the picture: an array of a cell's height for each line that the picture reaches."""
    if image is None or not image.size or not size.area:
        return []
    import numpy as np

    levels = fitted(image, size.width * cell[0], size.height * cell[1], LEVELS)
    rows, columns = levels.shape
    ground = np.full((-(-rows // cell[1]) * cell[1], columns), NOTHING)
    ground[:rows] = levels
    return [ground[y : y + cell[1]] for y in range(0, len(ground), cell[1])]


def sixels(levels: NDArray[np.int64]) -> str:
    """The escape sequence that draws (h, w) gray levels, and leaves what is `NOTHING` as it was.

    DEC STD 070, chapter 9: six rows a band, one pass a colour, runs as `!count`.
    """
    import numpy as np

    height, width = levels.shape
    used = [int(level) for level in np.unique(levels) if level != NOTHING]
    percent = {level: round(100 * level / (LEVELS - 1)) for level in used}
    out = ["\x1bP0;1;0q", f'"1;1;{width};{height}', *(f"#{k};2;{p};{p};{p}" for k, p in percent.items())]
    for top in range(0, height, BAND_PX):
        band = levels[top : top + BAND_PX]
        weights = 1 << np.arange(len(band))
        for level in np.unique(band):
            if level != NOTHING:
                out.append(f"#{level}{_runs(weights @ (band == level))}$")
        out.append("-")
    return "".join([*out, "\x1b\\"])


def _runs(bits: NDArray[np.int64]) -> str:
    signs = [(chr(63 + column), n) for column, n in runs(bits)]
    return "".join(f"!{n}{c}" if n > 3 else c * n for c, n in signs)


def cell_px() -> tuple[int, int]:
    """Width and height of a cell of this terminal; where it does not tell, a VT340's."""
    told = bytes(8)
    if sys.__stderr__ is not None:
        with contextlib.suppress(OSError, ValueError):
            told = fcntl.ioctl(sys.__stderr__.fileno(), termios.TIOCGWINSZ, told)
    rows, columns, width_px, height_px = struct.unpack("HHHH", told)
    if not (rows and columns and width_px and height_px):
        return VT340_CELL_PX
    return max(1, width_px // columns), max(1, height_px // rows)
