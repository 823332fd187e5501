"""Pictures in a terminal: braille cells that work anywhere, or pixels where textual-image finds that it has them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

from textual.app import ComposeResult
from textual.containers import Container
from textual.geometry import Region, Size
from textual.strip import Strip
from textual.widget import Widget

from brushloop.collect.tui.dots import Cells

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
        self._image: NDArray[np.uint8] | None = None
        self._cells = Cells(None, Size())
        self._made_for: Size | None = None

    def show(self, image: NDArray[np.uint8] | None) -> None:
        """Draw the lines of this picture that changed; nothing where it is the same object."""
        if image is self._image:
            return
        self._image, before = image, self._cells.codes
        self._fit(self._cells)
        codes = self._cells.codes
        if before is None or codes is None or before.shape != codes.shape or image is None or image.ndim == 3:
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


class ImagePicture(Container):
    """A picture in pixels, drawn by textual-image."""

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


AnyPicture = CellPicture | ImagePicture


class Pictures:
    """Makes picture widgets of the kind that this terminal shows best. Make it before the app takes the terminal."""

    def __init__(self, preview: Preview = "cells") -> None:
        self.camera_shown = preview != "off"
        self._make = _best_kind() if preview == "auto" else CellPicture

    def make(self, id: str) -> AnyPicture:  # noqa: A002 - textual's name
        """Make a widget."""
        return self._make(id)


def _best_kind() -> Callable[[str], AnyPicture]:
    """textual-image's widget, if that package is installed and has found that this terminal draws pixels."""
    try:
        from textual_image import renderable, widget
    except (ImportError, OSError, ValueError):
        # The extra is missing, or textual-image does not understand the terminal's answer.
        return CellPicture
    if renderable.Image in (renderable.SixelImage, renderable.TGPImage):
        return partial(ImagePicture, widget.Image)
    return CellPicture


def binary_picture(binary: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Ink black on white."""
    import numpy as np

    return np.where(binary, 0, 255).astype(np.uint8)
