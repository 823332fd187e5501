"""Pictures in a terminal: braille cells that work anywhere, or pixels where textual-image finds that it has them.

A braille cell has eight dots and two colours. Its ground has the colour of most of its pixels; the dots are the others.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from functools import lru_cache
from itertools import groupby
from typing import TYPE_CHECKING, Any, ClassVar

from rich.segment import Segment, Segments
from rich.style import Style
from textual.containers import Container
from textual.geometry import Size
from textual.widget import Widget

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

EMPTY = 0x2800
"""The braille pattern without dots; its 256 patterns follow each other."""
ROWS, COLUMNS = 4, 2
BITS = (0x01, 0x08, 0x02, 0x10, 0x04, 0x20, 0x40, 0x80)
"""The bit of each dot, row by row."""
LEVELS = 32
"""Steps of red, green and blue: fewer colours make longer runs, less to send over a slow line."""
FLAT = 24
"""Sum over three colours by which the pixels of a cell may differ without being drawn as dots: noise of the camera."""


def braille(image: NDArray[np.uint8], size: Size) -> NDArray[np.uint8]:
    """Fit a gray (h, w) or RGB (h, w, 3) picture into cells, its shape kept: (lines, columns, 7) of the dots, their
    colour, and the colour of their ground."""
    import cv2
    import numpy as np

    scale = min(COLUMNS * size.width / image.shape[1], ROWS * size.height / image.shape[0])
    columns = max(1, int(image.shape[1] * scale / COLUMNS))
    lines = max(1, int(image.shape[0] * scale / ROWS))
    small = np.asarray(cv2.resize(image, (COLUMNS * columns, ROWS * lines), interpolation=cv2.INTER_AREA), np.int64)
    pixels = small if small.ndim == 3 else small[..., None].repeat(3, axis=2)
    blocks = pixels.reshape(lines, ROWS, columns, COLUMNS, 3).swapaxes(1, 2).reshape(lines, columns, -1, 3)
    bright = blocks.sum(-1)
    low, high = bright.min(-1), bright.max(-1)
    dark = (2 * bright < (low + high)[..., None]) & (high - low >= FLAT)[..., None]
    count = dark.sum(-1)[..., None]
    bright_mean = (blocks * ~dark[..., None]).sum(2) // (ROWS * COLUMNS - count)
    dark_mean = (blocks * dark[..., None]).sum(2) // np.maximum(count, 1)  # nowhere drawn where there are none
    mostly_dark = count > ROWS * COLUMNS // 2
    dots = (dark ^ mostly_dark) @ np.array(BITS)
    pairs = np.where(mostly_dark, (bright_mean, dark_mean), (dark_mean, bright_mean))
    dot_colour, ground = pairs * LEVELS // 256 * 255 // (LEVELS - 1)
    return np.concatenate((dots[..., None], dot_colour, ground), axis=2).astype(np.uint8)


def text_of(lines: NDArray[np.uint8]) -> Iterator[Segment]:
    """Lines of cells as text."""
    for line in lines.tolist():
        for colours, cells in groupby(line, lambda cell: tuple(cell[1:])):
            yield Segment("".join(chr(EMPTY + cell[0]) for cell in cells), _style(colours))
        yield Segment.line()


@lru_cache(maxsize=4096)
def _style(colours: tuple[int, ...]) -> Style:
    return Style.parse("rgb({},{},{}) on rgb({},{},{})".format(*colours))


class CellPicture(Widget):
    """A picture in braille cells, as large as its place allows, its shape kept."""

    DEFAULT_CSS = """
    CellPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw this picture, unless it is the same object."""
        if image is not self._image:
            self._image = image
            self.refresh()

    def render(self) -> Segments:
        """The picture in the size of its place."""
        if self._image is None or not self._image.size or not self.size.area:
            return Segments(())
        return Segments(text_of(braille(self._image, self.size)))


class PixelPicture(Container):
    """A picture in pixels, drawn by textual-image."""

    DEFAULT_CSS = """
    PixelPicture { width: 1fr; height: 1fr; }
    PixelPicture > * { width: auto; height: 100%; }
    """
    drawn_by: ClassVar[type[Any] | None] = None
    """textual-image's widget, once `look_for_pixels` has found that this process's terminal has them."""

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        assert self.drawn_by is not None
        self._inner: Any = self.drawn_by()
        self._image: NDArray[np.uint8] | None = None
        super().__init__(self._inner, id=id)

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw this picture, unless it is the same object."""
        from PIL import Image

        if image is not self._image:
            self._image = image
            self._inner.image = None if image is None else Image.fromarray(image)


def look_for_pixels() -> None:
    """Draw pictures in pixels from now on, where textual-image finds that the terminal can.

    Call it before an app takes the terminal, which textual-image asks what it can do.
    """
    # The extra may be missing, or textual-image may not understand the terminal's answer.
    with contextlib.suppress(ImportError, OSError, ValueError):
        from textual_image import renderable, widget

        if renderable.Image in (renderable.SixelImage, renderable.TGPImage):
            PixelPicture.drawn_by = widget.Image


def picture_widget(id: str) -> CellPicture | PixelPicture:  # noqa: A002 - textual's name
    """A widget that shows pictures as well as this terminal can."""
    return CellPicture(id) if PixelPicture.drawn_by is None else PixelPicture(id)


def binary_picture(binary: NDArray[np.bool_] | None) -> NDArray[np.uint8] | None:
    """Ink black on white."""
    import numpy as np

    return None if binary is None else np.where(binary, 0, 255).astype(np.uint8)
