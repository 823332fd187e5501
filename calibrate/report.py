"""Write reports: pages from templates, pictures as data URIs, CSV, and JSON sealed by a digest."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import io
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Frozen, checked_fields
from brushloop.calibrate.compare import Image, shown
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.sessions.disk import read_bounded
from brushloop.sessions.messages import encode_png
from brushloop.sessions.records import Header, Source

PAPER = "#fbf9f4"
"""Background of charts and picture files."""
COLOURS = BLUE, ORANGE, *_ = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
"""Colours of Okabe and Ito for a chart's lines and points."""
CHART_DPI = 160
"""Resolution of charts in pages, which are also printed."""
PHOTOGRAPH_PX, JPEG_QUALITY = 1600, 80
"""Longest side and quality of a photograph in a page: about 500 kB at most."""
MAX_SEALED_BYTES = 256 * 1024 * 1024
ORIGIN = {
    Source.LOOPBACK: "simulated brush, ink and camera; not a result on paper",
    Source.REAL: "ink on paper, pressed by the arm named below",
    Source.IMPORT: "not collected by brushloop; scale and commands come from the import's table",
    Source.IMPORT_SIMULATED: "simulated ink, as declared when it was imported; not a result on paper",
}
"""Where the ink comes from."""
REMARK = re.compile(r"\(([^()]+)\)(?:, R = [^()]*)?$")
"""Finds the remark in brackets that ends the name of a described brush; the brush's size may follow it."""


def render(template: str, **values: Any) -> str:
    """Render `calibrate/templates/<template>`; an undefined name is an error.

    Names, licences and origins come from other people's files, so everything is escaped.
    """
    return templates().get_template(template).render(**values)


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write a page rendered from a template; returns its path. Raises OSError."""
    write_whole(path, render(template, **values))
    return path


def about(header: Header) -> dict[str, str]:
    """The `label` and the `note` of a page about one recording."""
    return {"label": source_label(header.source, [header.brush]), "note": source_note(header.source, header.brush)}


@functools.cache
def templates() -> Any:
    """The templates; each is compiled once in a process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("brushloop.calibrate")
    templates: Any = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    templates.globals |= {"brush_and_size": brush_and_size, "shown": shown, "image_uri": image_uri}
    templates.globals |= {"ink_uri": ink_uri, "overlay_uri": overlay_uri}
    return templates


def framed(page: Path) -> str:
    """A written page as a notebook shows it: in a frame of its own, because it has its own styles."""
    return f'<iframe srcdoc="{html.escape(page.read_text("utf-8"))}" width="100%" height="600"></iframe>'


def write_files(folder: Path, texts: Mapping[str, str]) -> None:
    """Write a report's files, each whole or not at all, in this order. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in texts.items():
        write_whole(folder / name, text)


def source_label(source: Source, brushes: Iterable[str] = ()) -> str:
    """The label of tables and figures: the source, and the remarks in the names of simulated brushes.

    A remark is what a described brush (`brushloop sim --brush FILE`) has in brackets at the end of its name.
    """
    remarks = [REMARK.search(brush) for brush in brushes] if source is Source.LOOPBACK else []
    return ", ".join((str(source), *dict.fromkeys(f"brush {remark[1]}" for remark in remarks if remark)))


def source_note(source: Source, brush: str = "") -> str:
    """One sentence on where the ink comes from."""
    return f"{source}: {ORIGIN[source]}{source_label(source, (brush,)).removeprefix(str(source))}"


@dataclass(frozen=True, slots=True)
class Point:
    """One thing to know before trusting a number; `good` is None if it is neither good nor bad."""

    good: bool | None
    text: str


def source_point(source: Source) -> Point:
    """Where the ink comes from, as a thing to know."""
    origin = ORIGIN[source]
    return Point(True if source is Source.REAL else None, f"{origin[0].upper()}{origin[1:]}.")


def brush_and_size(header: Header) -> str:
    """The brush, and its size where a header gives it."""
    name = header.brush or "a brush that is not named"
    if header.brush_radius_mm is None or header.brush_length_mm is None:
        return name
    return f"{name}, R = {header.brush_radius_mm:g} mm, L = {header.brush_length_mm:g} mm"


def data_uri(data: bytes, kind: str = "png") -> str:
    """An encoded PNG, or picture of another kind, as a data URI: no report ever fetches anything."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def image_uri(image: NDArray[np.uint8]) -> str:
    """An (h, w) gray or (h, w, 3) BGR image as a PNG data URI."""
    return data_uri(encode_png(image))


def photograph_uri(image: NDArray[np.uint8]) -> str:
    """An (h, w) gray photograph as a JPEG data URI, made smaller if a side is longer than `PHOTOGRAPH_PX`."""
    share = min(1.0, PHOTOGRAPH_PX / max(image.shape))
    small = cv2.resize(image, None, fx=share, fy=share, interpolation=cv2.INTER_AREA) if share < 1.0 else image
    data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return data_uri(data, "jpeg")


def ink_uri(ink: Image) -> str:
    """(h, w) ink in [0, 1] as black on white."""
    return image_uri(np.rint(255.0 * (1.0 - ink)).astype(np.uint8))


def overlay_uri(first: Image, second: Image) -> str:
    """`overlay` as a data URI."""
    return image_uri(np.rint(255.0 * overlay(first, second)[..., ::-1]).astype(np.uint8))


def overlay(first: Image, second: Image) -> Image:
    """(h, w, 3) RGB of two (h, w) images of ink: gray where both have it, orange the first alone, blue the second."""
    both = np.minimum(first, second)
    # The colours of Okabe and Ito, which colour-blind readers can distinguish, as distances from white.
    colours = np.array([[0.35, 0.35, 0.35], [0.165, 0.631, 1.0], [1.0, 0.553, 0.302]])
    darker = np.stack([both, first - both, second - both], axis=-1) @ colours
    return np.clip(1.0 - darker, 0.0, 1.0).astype(np.float32)


@functools.cache
def _glyphs() -> frozenset[int]:
    """Code points that the font of charts and picture files draws."""
    from matplotlib import font_manager

    untyped: Any = font_manager
    return frozenset(untyped.get_font(untyped.findfont("DejaVu Sans")).get_charmap())


def printable(text: str) -> str:
    """A name or label for the text of a picture, with `?` for every character that its font does not draw."""
    drawn = "".join(c if c.isprintable() and ord(c) in _glyphs() else "?" for c in text)
    return drawn.replace("$", r"\$")  # otherwise it begins a formula


def picture_grid(rows: int, columns: int, size: tuple[float, float], title: str = "") -> tuple[Any, Any]:
    """A figure for a chart or a picture file and its (rows, columns) axes; size in inches at 100 dpi."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(size, dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(printable(title), fontsize=10)
    return figure, figure.subplots(rows, columns, squeeze=False)


def chart_uri(figure: Any) -> str:
    """A figure of `picture_grid` as a PNG data URI, with a legend if lines are labelled.

    The same figure gives the same bytes.
    """
    for axis in figure.axes:
        axis.grid(color="#ddd8ce", linewidth=0.6)
        if axis.get_legend_handles_labels()[1]:
            axis.legend()
    figure.set_dpi(CHART_DPI)
    picture = io.BytesIO()
    figure.canvas.print_png(picture, metadata={"Software": None})
    return data_uri(picture.getvalue())


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure of `picture_grid` as PNG. Raises OSError."""
    figure.canvas.print_png(path, metadata={"Software": None})  # `savefig` would lay it out and draw it twice


class Sealed(Frozen):
    """Base class of JSON reports with a digest of their contents, by which an edited one is recognised.

    The digest is not a signature: it guards results and their source against accidental edits.
    """

    FILE: ClassVar[str]
    FORMAT: ClassVar[str]
    MADE_BY: ClassVar[str]
    """The command that writes such a file."""

    format: str = ""
    digest: str = ""
    """`FORMAT`, and the SHA-256 of everything else, once it is sealed."""

    def sealed(self) -> Self:
        """A copy with its format and digest."""
        whole = self.model_copy(update={"format": self.FORMAT})
        return whole.model_copy(update={"digest": _digest(whole.model_dump(mode="json"))})

    def to_json(self) -> str:
        """The text that is written to disk."""
        return json.dumps(self.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read such a file, or the one in a folder.

        Raises `InputError`, naming the file, if there is none, or it is something else, is too new or was edited.
        """
        path = path / cls.FILE if path.is_dir() else path
        try:
            fields: Any = json.loads(read_bounded(path, MAX_SEALED_BYTES))
            # Digest of the file, not of the model: a field that was added to the model later is not an edit.
            known, digest, fields_format = fields["digest"], _digest(fields), fields["format"]
        except (ValueError, RecursionError, TypeError, KeyError):  # no JSON, text that is no Unicode, or something else
            what = f"is not a report with a digest: write it with `{cls.MADE_BY}`"
            raise CalibrationError(str(path), what) from None
        if fields_format != cls.FORMAT:
            raise CalibrationError(str(path), f"format is {str(fields_format)[:40]!r}, not {cls.FORMAT!r}")
        if known != digest:
            raise CalibrationError(str(path), "was edited: its digest does not match its contents")
        with checked_fields(str(path)):
            return cls.model_validate(fields)


def _digest(contents: dict[str, Any]) -> str:
    text = json.dumps(contents | {"digest": ""}, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
