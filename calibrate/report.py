"""Write reports: pages from templates, pictures as data URIs, CSV, and JSON sealed by a digest."""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import ValidationError

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.errors import CalibrationError, invalid
from brushloop.calibrate.files import read_bounded, write_whole
from brushloop.sessions.records import Header, Source

Image = NDArray[np.float32]
Floats = NDArray[np.float64]
PAPER = "#fbf9f4"
"""Background of picture files."""
COLOURS = BLUE, ORANGE, *_ = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"
"""Colours of Okabe and Ito for a chart's lines and points."""
LINE_PX, CHAR_PX, PADDING = 16, 7, 0.04
"""Height of a line of a chart's text, about the width of a character, and the margin of an axis as a share of it."""
PHOTOGRAPH_PX, JPEG_QUALITY = 1600, 80
"""Longest side and quality of a photograph in a page: about 500 kB at most."""
MAX_SEALED_BYTES = 256 * 1024 * 1024
ORIGIN = {
    Source.LOOPBACK: "simulated brush, ink and camera; not a result on paper",
    Source.REAL: "ink on paper, pressed by the arm named below",
    Source.IMPORT: "not collected by brushloop; scale and commands come from their table",
    Source.IMPORT_SIMULATED: "simulated ink, as declared when it was imported; not a result on paper",
}
"""Where the ink comes from."""
REMARK = re.compile(r"\(([^()]+)\)(?:, R = [^()]*)?$")
"""Finds the remark in brackets that ends the name of a described brush; the brush's size may follow it."""


def render(template: str, **values: Any) -> str:
    """Render `calibrate/templates/<template>`; an undefined name is an error.

    Names, licences and origins come from other people's files, so everything is escaped.
    """
    return _templates().get_template(template).render(**values)


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write a page rendered from a template; returns its path. Raises OSError."""
    write_whole(path, render(template, **values))
    return path


def about(header: Header) -> dict[str, str]:
    """The `label` and the `note` of a page about one recording."""
    return {"label": source_label(header.source, [header.brush]), "note": source_note(header.source, header.brush)}


@functools.cache
def _templates() -> Any:
    """The templates; each is compiled once in a process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("brushloop.calibrate")
    templates: Any = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    templates.globals["brush_and_size"] = brush_and_size
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
    """The brush and its size, where a header names them."""
    size = ""
    if header.brush_radius_mm is not None and header.brush_length_mm is not None:
        size = f"R = {header.brush_radius_mm:g} mm, L = {header.brush_length_mm:g} mm"
    return ", ".join(filter(None, (header.brush, size)))


def data_uri(data: bytes, kind: str = "png") -> str:
    """An encoded PNG, or picture of another kind, as a data URI: no report ever fetches anything."""
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


def image_uri(image: NDArray[np.uint8]) -> str:
    """An (h, w) gray or (h, w, 3) BGR image as a PNG data URI."""
    import cv2

    return data_uri(cv2.imencode(".png", image)[1].tobytes())


def photograph_uri(image: NDArray[np.uint8]) -> str:
    """An (h, w) gray photograph as a JPEG data URI, made smaller if a side is longer than `PHOTOGRAPH_PX`."""
    import cv2

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
    darker = (
        both[..., None] * np.array([0.35, 0.35, 0.35])
        + (first - both)[..., None] * np.array([0.165, 0.631, 1.0])
        + (second - both)[..., None] * np.array([1.0, 0.553, 0.302])
    )
    return np.clip(1.0 - darker, 0.0, 1.0).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Marks:
    """Points of a chart, (n,) x and y, as dots, joined by a line, or both; a point that is not finite is left out."""

    x: ArrayLike
    y: ArrayLike
    colour: str = BLUE
    name: str = ""
    """In the legend, if there is one."""
    dot_px: float = 0.0
    line_px: float = 0.0
    """Diameter of the dots and width of the line; 0 for none."""


@dataclass(frozen=True, slots=True)
class Axis:
    """An axis of a chart; without `ticks` (value -> text) up to seven round values are chosen."""

    name: str = ""
    ticks: Mapping[float, str] | None = None
    log: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes of a chart."""

    title: str
    x: Axis
    y: Axis
    marks: Sequence[Marks]


def chart_uri(panels: Sequence[Panel], size_px: tuple[int, int], title: str = "") -> str:
    """Panels side by side below a title, as an SVG data URI; the same panels give the same bytes."""
    width, height = size_px
    side, head = width // len(panels), _lines(title, width)
    above, heads = LINE_PX * (1 + len(head)), [_lines(panel.title, side) for panel in panels]
    legends = [[(mark.colour, printable(mark.name)) for mark in panel.marks if mark.name] for panel in panels]
    top = above + LINE_PX * (max(map(len, heads)) + any(legends)) - 4
    bottom = height - 3 * LINE_PX
    drawn: list[dict[str, Any]] = []
    for k, panel in enumerate(panels):
        y_of, y_ticks = _scale(panel.y, [mark.y for mark in panel.marks], bottom, top)
        beside = CHAR_PX * max(len(text) for _, text in y_ticks) + (2 if panel.y.name else 1) * LINE_PX
        frame = {"edge": k * side, "left": k * side + beside, "right": (k + 1) * side - LINE_PX}
        x_of, x_ticks = _scale(panel.x, [mark.x for mark in panel.marks], frame["left"], frame["right"])
        marks: list[tuple[Marks, list[tuple[float, float]]]] = []
        for mark in panel.marks:
            places = np.stack([x_of(np.asarray(mark.x)), y_of(np.asarray(mark.y))], axis=-1)
            marks.append((mark, places[np.isfinite(places).all(axis=1)].tolist()))
        axes = {"x": panel.x, "y": panel.y, "x_ticks": x_ticks, "y_ticks": y_ticks}
        drawn.append({"title": heads[k], "marks": marks, "legend": legends[k], **axes, **frame})
    about = {"width": width, "height": height, "title": head, "above": above, "top": top, "bottom": bottom}
    return data_uri(render("chart.svg.j2", panels=drawn, **about).encode(), "svg+xml")


def _scale(
    axis: Axis, values: Sequence[ArrayLike], start_px: float, end_px: float
) -> tuple[Callable[[Floats], Floats], list[tuple[float, str]]]:
    """Where values lie along an axis, in pixels, and its ticks with their texts."""
    known = np.concatenate([np.asarray(part, np.float64) for part in values]) if values else np.ones(1)
    known = known[np.isfinite(known)] if np.isfinite(known).any() else np.ones(1)
    ticks = axis.ticks or round_values(float(known.min()), float(known.max()), log=axis.log)
    shape = np.log10 if axis.log else np.positive
    ends = shape(np.array([*known, *ticks], np.float64))
    low, range_of = float(ends.min()), float(np.ptp(ends)) or 1.0
    step_px = (end_px - start_px) / (1.0 + 2.0 * PADDING) / range_of

    def place(at: Floats) -> Floats:
        return np.round(start_px + (shape(at) - low + PADDING * range_of) * step_px, 1)

    return place, list(zip(place(np.array([*ticks], np.float64)).tolist(), ticks.values(), strict=True))


def round_values(low: float, high: float, *, log: bool = False) -> dict[float, str]:
    """Up to seven round values between two: powers of ten on a logarithmic axis that holds two of them."""
    if log and (powers := range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1))[1:]:
        return {10.0**power: f"{10.0**power:g}" for power in powers}
    if low == high:
        return {low: f"{low:.6g}"}
    rough = (high - low) / 7.0
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(unit for unit in (1, 2, 5, 10) if unit * power >= rough)
    return {k * step: f"{k * step:.6g}" for k in range(math.ceil(low / step), math.floor(high / step) + 1)}


def _lines(text: str, width_px: int) -> list[str]:
    """The text in lines of at most about this width."""
    return textwrap.wrap(printable(text), max(1, width_px // CHAR_PX))


def printable(text: str) -> str:
    """A name or label for the text of a plot, with `?` for every character that no font draws."""
    return "".join(c if c.isprintable() else "?" for c in text)


def picture_grid(rows: int, columns: int, size: tuple[float, float], title: str = "") -> tuple[Any, Any]:
    """A figure for a picture file and its (rows, columns) axes; size in inches at 100 dpi."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure: Any = Figure(size, dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, fontsize=10)
    return figure, figure.subplots(rows, columns, squeeze=False)


def save_picture(figure: Any, path: Path) -> None:
    """Write a figure of `picture_grid` as PNG. Raises OSError."""
    figure.canvas.print_png(path, metadata={"Software": None})  # `savefig` would lay it out and draw it twice


class Sealed(Frozen):
    """Base class of JSON reports with a digest of their contents, by which an edited one is recognised.

    The digest is not a signature: it guards results and their source against accidental edits.
    """

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


S = TypeVar("S", bound=Sealed)


def load_sealed(path: Path, kind: type[S]) -> S:
    """Read a JSON report. Raises `CalibrationError`, naming the file, if it is not one, is too new or was edited."""
    try:
        fields: Any = json.loads(read_bounded(path, MAX_SEALED_BYTES))
        # Digest of the file, not of the model: a field that was added to the model later is not an edit.
        known, digest, fields_format = fields["digest"], _digest(fields), fields["format"]
    except (ValueError, RecursionError, TypeError, KeyError):  # no JSON, text that is no Unicode, or something else
        what = f"is not a report with a digest: write it with `{kind.MADE_BY}`"
        raise CalibrationError(str(path), what) from None
    if fields_format != kind.FORMAT:
        raise CalibrationError(str(path), f"format is {str(fields_format)[:40]!r}, expected {kind.FORMAT!r}")
    if known != digest:
        raise CalibrationError(str(path), "was edited: its digest does not match its contents")
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise invalid(str(path), error) from None


def _digest(contents: dict[str, Any]) -> str:
    text = json.dumps(contents | {"digest": ""}, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()
