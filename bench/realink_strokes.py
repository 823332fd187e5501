"""Real dragged strokes for `bench realink`: FRIDA's brushes, ink as images, and the path that was commanded.

The strokes sit in a GPL-3.0 repository and are read from where they lie; nothing of them is kept here. The path follows
the source's public stroke format: a cubic Bezier curve with control points (0, 0), (L/3, bend), (2L/3, bend), (L, 0),
its depth rising from .2 of the travel to z over the first third, held, and back over the last.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError
from brushloop.calibrate.drags.captures import Drawn, commanded_path
from brushloop.calibrate.drags.measure import defects
from brushloop.sessions.records import Header, Source

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
BIG, SMALL_A, SMALL_B = "frida_bigbrush_tilt_16x20", "frida_smallbrush_16x20_a", "frida_smallbrush_16x20_b"
TRAVEL_MM = {BIG: 18.0, SMALL_A: 1.5, SMALL_B: 3.0}
END_SHARE = 0.2
PX_PER_MM = 2.5
CROP_MM = (-16.0, 76.0, 32.0)
DARK = 0.5
SECOND_PAGE = 97
"""The stroke that begins the second page: the placement of the training strokes jumps there."""
ACROSS = 9
"""Strokes side by side on a page, as the source's page loop lays them out."""
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Strokes:
    """All usable strokes on one grid, which has the commanded start at (0, 0)."""

    names: tuple[str, ...]
    commands: Floats
    """(n, 4): length mm, bend mm, z as a share of the travel, tilt deg."""
    paths: tuple[Floats, ...]
    """(28, 4) each: x, y, depth in mm, heading in deg."""
    travel_mm: float
    ink: NDArray[np.bool_]
    """(n, rows, columns)."""
    x_mm: Floats
    y_mm: Floats
    place: Floats
    """(n, 3): row and column on the page, about -1 to 1, and the page: from the order of the strokes."""


def load(name: str = BIG, data: Path = DATA) -> Strokes:
    """Read the strokes; blank ones and those that reach the edge of their image are left out.

    Raises BenchError where the data set is not at hand.
    """
    folder, travel_mm = data / name, TRAVEL_MM[name]
    table = folder / "strokes.csv"
    if not table.exists():
        raise BenchError(f"the real strokes ({name}) are not beside this checkout")
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    kept: list[int] = []
    images: list[NDArray[np.bool_]] = []
    for index, row in enumerate(rows):
        dark = 1.0 - _gray(folder / row["file"], float(row["px_per_mm_x"])) / 255.0
        ink = dark > DARK
        edge = ink[0].any() or ink[-1].any() or ink[:, 0].any() or ink[:, -1].any()
        if ink.any() and not edge:
            kept.append(index)
            images.append(ink)
    commands = np.array([[float(rows[k][c]) for c in ("length_mm", "bend_mm", "z_frac_mid", "tilt_deg")] for k in kept])
    start = [float(rows[0][c]) / float(rows[0]["px_per_mm_x"]) for c in ("start_x_px", "start_y_px")]
    x_mm = (np.arange(images[0].shape[1]) + 0.5) / PX_PER_MM - start[0]
    y_mm = start[1] - (np.arange(images[0].shape[0]) + 0.5) / PX_PER_MM
    on_page = np.array([k - SECOND_PAGE if k >= SECOND_PAGE else k for k in kept])
    place = np.column_stack([on_page // ACROSS / 5.0 - 1, on_page % ACROSS / 4.0 - 1, np.array(kept) >= SECOND_PAGE])
    ends_mm = END_SHARE * travel_mm
    paths = tuple(commanded_path(length, bend, z * travel_mm, ends_mm) for length, bend, z, _ in commands)
    names = tuple(rows[k]["file"] for k in kept)
    return Strokes(names, commands, paths, travel_mm, np.array(images), x_mm, y_mm, place.astype(np.float64))


def region(strokes: Strokes) -> tuple[slice, slice, slice]:
    """Rows and columns that hold every stroke; the network is trained on them."""
    left, right, reach = CROP_MM
    columns = np.flatnonzero((strokes.x_mm > left) & (strokes.x_mm < right))
    rows = np.flatnonzero(np.abs(strokes.y_mm) < reach)
    return slice(None), slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def drawn(strokes: Strokes, name: str) -> Drawn:
    """The strokes as `calibrate.drags` reads them from a session, on the grid of the bench."""
    length, bend, z, tilt = strokes.commands.T
    depth, ends = z * strokes.travel_mm, np.full(len(z), END_SHARE * strokes.travel_mm)
    return Drawn(
        header=Header(session_id=name, source=Source.IMPORT, software="bench", protocol=""),
        recording_sha256="",
        calibration=None,
        x_mm=strokes.x_mm,
        y_mm=strokes.y_mm,
        paths=list(strokes.paths),
        groups=np.arange(len(z) + 1),
        ink=strokes.ink.astype(np.float32),
        stroke_ids=list(strokes.names),
        refused=[],
        commands=np.column_stack([length, bend, depth, ends, tilt]),
        flags=[defects(_at_20_px(mask)) for mask in strokes.ink],
        ends="z_frac_ends",
    )


def _at_20_px(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Strokes are judged at 20 px/mm; these were read at 2.5."""
    return np.repeat(np.repeat(mask, 8, axis=0), 8, axis=1)


def _gray(path: Path, px_per_mm: float) -> NDArray[np.float64]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise BenchError(f"{path.name} cannot be read")
    size = (round(image.shape[1] * PX_PER_MM / px_per_mm), round(image.shape[0] * PX_PER_MM / px_per_mm))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float64)
