"""Real dragged strokes for `bench realink`: FRIDA's big brush, ink as images, and the path that was commanded.

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

FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data" / "frida_bigbrush_tilt_16x20"
PX_PER_MM = 2.5
DARK = 0.5
TRAVEL_MM = 18.0
NODES = 28
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
    """(28, 3) each: x, y, depth in mm."""
    ink: NDArray[np.bool_]
    """(n, rows, columns)."""
    x_mm: Floats
    y_mm: Floats
    place: Floats
    """(n, 3): row and column on the page, about -1 to 1, and the page: from the order of the strokes."""


def load(folder: Path = FOLDER) -> Strokes:
    """Read the strokes; blank ones and those that reach the edge of their image are left out.

    Raises BenchError where the data set is not at hand.
    """
    table = folder / "strokes.csv"
    if not table.exists():
        raise BenchError("the real strokes (frida_bigbrush_tilt_16x20) are not beside this checkout")
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
    paths = tuple(commanded_path(*command[:3]) for command in commands)
    names = tuple(rows[k]["file"] for k in kept)
    return Strokes(names, commands, paths, np.array(images), x_mm, y_mm, place.astype(np.float64))


def commanded_path(length_mm: float, bend_mm: float, z_share: float) -> Floats:
    """(28, 3) x, y, depth of the tip, mm, y upward."""
    t = np.linspace(0.0, 1.0, NODES)
    z = np.interp(t, [0.0, 1 / 3, 2 / 3, 1.0], [0.2, z_share, z_share, 0.2])
    return np.column_stack([length_mm * t, 3.0 * bend_mm * t * (1.0 - t), TRAVEL_MM * z])


def captured_distance(ink: NDArray[np.bool_]) -> Floats:
    """Signed distance to the edge of captured ink, positive inside, (n, rows, columns) mm."""
    out = np.empty(ink.shape)
    for k, mask in enumerate(ink):
        inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5) - 0.5
        out[k] = np.where(mask, inside, -outside) / PX_PER_MM
    return out


def _gray(path: Path, px_per_mm: float) -> NDArray[np.float64]:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise BenchError(f"{path.name} cannot be read")
    size = (round(image.shape[1] * PX_PER_MM / px_per_mm), round(image.shape[0] * PX_PER_MM / px_per_mm))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float64)
