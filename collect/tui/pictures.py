"""Gray pictures in a terminal: half-cells that work anywhere, or pixels where textual-image finds that it has them.

A half-cell is `▀` with its own two grays: over SSH and tmux as good as any other text.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal

from rich.segment import Segment
from rich.style import Style
from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Size
from textual.strip import Strip
from textual.widget import Widget

from collect.tui.gray import fitted, runs
from collect.tui.sixel import SixelPicture

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

HALF = "▀"
LEVELS = 32
"""Grays that are told apart: fewer styles, longer runs, less to send over a slow line."""
Kind = Literal["auto", "cells", "off"]


class CellPicture(Widget):
    """A picture in half-cells, as large as its place allows, its shape kept."""

    DEFAULT_CSS = """
    CellPicture { width: 1fr; height: 1fr; }
    """

    def __init__(self, id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._image: NDArray[np.uint8] | None = None
        self._strips: list[Strip] = []
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw another picture; the same object is not drawn twice."""
        if image is not self._image:
            self._image, self._made_for = image, None
            self.refresh()

    def render_line(self, y: int) -> Strip:
        """One line of half-cells."""
        if self._made_for != self.size:
            self._strips, self._made_for = _strips(self._image, self.size), self.size
        width, ground = self.size.width, self.rich_style
        if y >= len(self._strips):
            return Strip.blank(width, ground)
        return self._strips[y].extend_cell_length(width, ground)


class ImagePicture(Container):
    """The same over textual-image, in pixels by kitty's protocol."""

    DEFAULT_CSS = """
    ImagePicture { width: 1fr; height: 1fr; }
    ImagePicture > * { width: auto; height: 100%; }
    """

    def __init__(self, widget: type[Any], id: str | None = None) -> None:  # noqa: A002 - textual's name
        super().__init__(id=id)
        self._inner: Any = widget()
        self._image: NDArray[np.uint8] | None = None

    def compose(self) -> ComposeResult:
        """textual-image's own widget."""
        yield self._inner

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw another picture."""
        if image is self._image:
            return
        self._image = image
        if image is None:
            self._inner.image = None
            return
        from PIL import Image

        self._inner.image = Image.fromarray(image)


class Pictures:
    """Makes picture widgets of the kind that this terminal shows best. Made before the app takes the terminal."""

    def __init__(self, kind: Kind = "cells") -> None:
        self.kind: Kind = kind
        self._make = _pixels() if kind == "auto" else CellPicture

    def make(self, id: str) -> CellPicture | SixelPicture | ImagePicture:  # noqa: A002 - textual's name
        """A new widget."""
        return self._make(id)


def binary_picture(binary: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Ink black on white."""
    import numpy as np

    return np.where(binary, 0, 255).astype(np.uint8)


def _pixels() -> Callable[[str], CellPicture | SixelPicture | ImagePicture]:
    """What this terminal shows best; asks it, so call it early. Half-cells where textual-image is not installed."""
    try:
        from textual_image.renderable import Image, SixelImage, TGPImage
        from textual_image.widget import TGPImage as Widget
    except (ImportError, OSError, ValueError):
        # The extra is missing, or the terminal answered its question in a way that it does not understand.
        return CellPicture
    if Image is SixelImage:
        return SixelPicture
    return partial(ImagePicture, Widget) if Image is TGPImage else CellPicture


def _strips(image: NDArray[np.uint8] | None, size: Size) -> list[Strip]:
    if image is None or not image.size or size.width < 1 or size.height < 1:
        return []
    # A cell is about twice as high as wide: a half-cell is a square.
    levels = fitted(image, size.width, 2 * size.height, LEVELS, step=2)
    return [_strip(levels[y], levels[y + 1]) for y in range(0, len(levels), 2)]


def _strip(top: NDArray[np.int64], bottom: NDArray[np.int64]) -> Strip:
    pair = top * LEVELS + bottom
    return Strip([Segment(HALF * count, _style(value)) for value, count in runs(pair)], len(pair))


@lru_cache(maxsize=LEVELS * LEVELS)
def _style(pair: int) -> Style:
    top, bottom = (round(level * 255 / (LEVELS - 1)) for level in divmod(pair, LEVELS))
    return Style.parse(f"rgb({top},{top},{top}) on rgb({bottom},{bottom},{bottom})")
