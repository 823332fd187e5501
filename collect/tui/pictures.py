"""Pictures in a terminal: braille cells that work anywhere, or pixels (sixels, kitty's protocol) where it has them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from rich.segment import ControlType, Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from collect.tui.dots import Cells
from collect.tui.graphics import PixelKind, pixels_of_terminal
from collect.tui.levels import Coloured
from collect.tui.sixel import SIXEL_GRAYS, VT340_CELL_PX, lines_of, sixels, terminal_cell_px

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Preview = Literal["auto", "cells", "off"]
"""How pictures are shown: in pixels where the terminal has them, in cells, or without those of the camera."""


class CellPicture(Widget):
    """A picture in braille cells, as large as its place allows, its shape kept."""

    DEFAULT_CSS = """
    CellPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | Coloured | None = None
        self._cells = Cells(None, Size())
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | Coloured | None) -> None:
        """Draw the lines of this picture that changed; nothing where it is the same object."""
        if image is self._image:
            return
        self._image, before = image, self._cells.codes
        self._fit(self._cells)
        codes = self._cells.codes
        if before is None or codes is None or before.shape != codes.shape or isinstance(image, Coloured):
            self.refresh()
            return
        for y in (before != codes).any(axis=1).nonzero()[0].tolist():
            self.refresh(Region(0, y, self.size.width, 1))

    def render_line(self, y: int) -> Strip:
        """Draw one line of cells."""
        if self._made_for != self.size:
            self._fit(None)
        width, ground = self.size.width, self.rich_style
        if self._cells.codes is None or y >= len(self._cells.codes):
            return Strip.blank(width, ground)
        return self._cells.strip(y).extend_cell_length(width, ground)

    def _fit(self, before: Cells | None) -> None:
        self._cells, self._made_for = Cells(self._image, self.size, before), self.size


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

    def show(self, image: NDArray[np.uint8] | Coloured | None) -> None:
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
        self._image: NDArray[np.uint8] | Coloured | None = None
        self._lines: list[NDArray[np.int64]] = []
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | Coloured | None) -> None:
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
        drawn = sixels(self._lines[y], self._image.colours if isinstance(self._image, Coloured) else SIXEL_GRAYS)
        pixels = f"\x1b[{width}D\x1b7{drawn}\x1b8\x1b[{width}C"
        control = Segment(pixels, Style.null(), ((ControlType.CURSOR_FORWARD, 0),))
        return Strip([Segment(" " * width, ground), control], width)

    def _fit(self) -> None:
        self._made_for = self.size
        self._lines = lines_of(self._image, self.size, terminal_cell_px() or VT340_CELL_PX)


class ImagePicture(Container):
    """A picture by textual-image, in pixels by kitty's protocol."""

    DEFAULT_CSS = """
    ImagePicture { width: 1fr; height: 1fr; }
    ImagePicture > * { width: auto; height: 100%; }
    """

    def __init__(self, widget: type[Any], id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._inner: Any = widget()
        self._image: NDArray[np.uint8] | Coloured | None = None

    def compose(self) -> ComposeResult:
        """Lay out textual-image's own widget."""
        yield self._inner

    def show(self, image: NDArray[np.uint8] | Coloured | None) -> None:
        """Draw this picture, unless it is the same object."""
        if image is self._image:
            return
        self._image = image
        if image is None:
            self._inner.image = None
            return
        import numpy as np
        from PIL import Image

        if isinstance(image, Coloured):
            image = np.array(image.colours, np.uint8)[image.pixels]
        self._inner.image = Image.fromarray(image)


AnyPicture = CellPicture | SixelPicture | ImagePicture


class Pictures:
    """Makes picture widgets of the kind that this terminal shows best. Make it before the app takes the terminal."""

    def __init__(self, preview: Preview = "cells") -> None:
        self.camera_shown = preview != "off"
        self._make = _best_kind(pixels_of_terminal()) if preview == "auto" else CellPicture

    def make(self, id: str) -> AnyPicture:  # noqa: A002 - textual's name
        """Make a widget."""
        return self._make(id)


def _best_kind(pixels: PixelKind) -> Callable[[str], AnyPicture]:
    """The widget for the pixels that the terminal has; kitty's protocol needs the package textual-image."""
    if pixels == "sixel":
        return SixelPicture
    if pixels == "kitty":
        try:
            from textual_image.widget import TGPImage
        except (ImportError, OSError, ValueError):
            # The extra is missing, or textual-image does not understand the terminal's answer.
            return CellPicture
        return partial(ImagePicture, TGPImage)
    return CellPicture


def binary_picture(binary: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Ink black on white."""
    import numpy as np

    return np.where(binary, 0, 255).astype(np.uint8)
