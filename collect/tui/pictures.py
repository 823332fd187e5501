"""Gray pictures in a terminal: half-cells that work anywhere, or pixels (sixels, kitty's protocol) where it has them.

A half-cell is `▀` with its own two grays: over SSH and tmux as good as any other text.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

from rich.segment import ControlType, Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from collect.tui.sixel import fitted, lines_of, runs, sixels, terminal_cell_px

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

HALF = "▀"
LEVELS = 32
"""Grays of a picture in half-cells: fewer styles make longer runs, less to send over a slow line."""
Preview = Literal["auto", "cells", "off"]
"""How the camera is shown: in pixels where the terminal has them, in half-cells, or not at all."""


class CellPicture(Widget):
    """A picture in half-cells, as large as its place allows, its shape kept."""

    DEFAULT_CSS = """
    CellPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | None = None
        self._lines: NDArray[np.int64] | None = None
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw the lines of this picture that changed; nothing where it is the same object."""
        if image is self._image:
            return
        self._image, before = image, self._lines
        self._fit(before)
        if before is None or self._lines is None or before.shape != self._lines.shape:
            self.refresh()
            return
        for y in (before != self._lines).any(axis=1).nonzero()[0].tolist():
            self.refresh(Region(0, y, self.size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Draw one line of half-cells."""
        if self._made_for != self.size:
            self._fit(None)
        width, ground = self.size.width, self.rich_style
        if self._lines is None or y >= len(self._lines):
            return Strip.blank(width, ground)
        return _strip(self._lines[y]).extend_cell_length(width, ground)

    def _fit(self, before: NDArray[np.int64] | None) -> None:
        self._lines, self._made_for = half_cells(self._image, self.size, before), self.size


class SixelPicture(Container):
    """A picture in sixels, as large as its place allows, its shape kept.

    The border belongs to this container, not to the pixels' widget: textual cuts and pads the lines of a widget with a
    border, and drops the pixels.
    """

    DEFAULT_CSS = """
    SixelPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._pixels = Pixels()

    def compose(self) -> ComposeResult:
        """Lay out the pixels."""
        yield self._pixels

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw this picture, unless it is the same object."""
        self._pixels.show(image)


class Pixels(Widget):
    """The sixels themselves, one image for each line of cells.

    textual repaints lines, not pictures: an image over many lines would be drawn again at every change of one of them,
    and where it reaches below the last line it scrolls the screen.
    """

    DEFAULT_CSS = """
    Pixels { width: 1fr; height: 1fr; }
    """

    def __init__(self) -> None:
        super().__init__()
        self._image: NDArray[np.uint8] | None = None
        self._lines: list[NDArray[np.int64]] = []
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw the lines of this picture that changed; nothing where it is the same object."""
        if image is self._image:
            return
        self._image = image
        before, size = self._lines, self.size
        self._fit()
        for y in range(size.height):
            old, new = (lines[y] if y < len(lines) else None for lines in (before, self._lines))
            if old is None or new is None or old.shape != new.shape or (old != new).any():
                self.refresh(Region(0, y, size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Draw blank cells, which erase what was there, and the pixels over them."""
        if self._made_for != self.size:
            self._fit()
        width, ground = self.size.width, self.rich_style
        # While something lies over the screen, textual dims what is below; pixels cannot be dimmed.
        if y >= len(self._lines) or not self.screen.is_active:
            return Strip.blank(width, ground)
        pixels = f"\x1b[{width}D\x1b7{sixels(self._lines[y])}\x1b8\x1b[{width}C"
        control = Segment(pixels, Style.null(), ((ControlType.CURSOR_FORWARD, 0),))
        return Strip([Segment(" " * width, ground), control], width)

    def _fit(self) -> None:
        self._made_for = self.size
        self._lines = lines_of(self._image, self.size, terminal_cell_px())


class ImagePicture(Container):
    """A picture by textual-image, in pixels by kitty's protocol."""

    DEFAULT_CSS = """
    ImagePicture { width: 1fr; height: 1fr; }
    ImagePicture > * { width: auto; height: 100%; }
    """

    def __init__(self, widget: type[Any], id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._inner: Any = widget()
        self._image: NDArray[np.uint8] | None = None

    def compose(self) -> ComposeResult:
        """Lay out textual-image's own widget."""
        yield self._inner

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw this picture, unless it is the same object."""
        if image is self._image:
            return
        self._image = image
        if image is None:
            self._inner.image = None
            return
        from PIL import Image

        self._inner.image = Image.fromarray(image)


AnyPicture = CellPicture | SixelPicture | ImagePicture


class Pictures:
    """Makes picture widgets of the kind that this terminal shows best. Make it before the app takes the terminal."""

    def __init__(self, preview: Preview = "cells") -> None:
        self.camera_shown = preview != "off"
        self._make = _best_kind() if preview == "auto" else CellPicture

    def make(self, id: str) -> AnyPicture:  # noqa: A002 - textual's name
        """Make a widget."""
        return self._make(id)


def _best_kind() -> Callable[[str], CellPicture | SixelPicture | ImagePicture]:
    """Ask the terminal which kind it shows; half-cells if textual-image is not installed."""
    try:
        from textual_image.renderable import Image, SixelImage, TGPImage
        from textual_image.widget import TGPImage as Widget
    except (ImportError, OSError, ValueError):
        # The extra is missing, or textual-image does not understand the terminal's answer.
        return CellPicture
    if Image is SixelImage:
        return SixelPicture
    return partial(ImagePicture, Widget) if Image is TGPImage else CellPicture


def binary_picture(binary: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Ink black on white."""
    import numpy as np

    return np.where(binary, 0, 255).astype(np.uint8)


def half_cells(
    image: NDArray[np.uint8] | None, size: Size, before: NDArray[np.int64] | None = None
) -> NDArray[np.int64] | None:
    """The picture fitted into `size` cells: (lines, columns) of pairs of grays, upper * LEVELS + lower; None for none.

    `before` are the pairs of the picture before, of which those stay that are still right; see `fitted`.
    """
    if image is None or not image.size or size.width < 1 or size.height < 1:
        return None
    import numpy as np

    grays = None if before is None else np.stack(divmod(before, LEVELS), axis=1).reshape(-1, before.shape[1])
    # A cell is about twice as high as wide: a half-cell is a square.
    levels = fitted(image, size.width, 2 * size.height, LEVELS, step=2, before=grays)
    return levels[::2] * LEVELS + levels[1::2]


def _strip(pairs: NDArray[np.int64]) -> Strip:
    return Strip([Segment(HALF * count, _style(pair)) for pair, count in runs(pairs)], len(pairs))


@lru_cache(maxsize=LEVELS * LEVELS)
def _style(pair: int) -> Style:
    top, bottom = (round(level * 255 / (LEVELS - 1)) for level in divmod(pair, LEVELS))
    return Style.parse(f"rgb({top},{top},{top}) on rgb({bottom},{bottom},{bottom})")
