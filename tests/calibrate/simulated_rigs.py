"""Five brushes with five cameras, and what they see: frozen before any score of preprocessing or scale was looked at.

Everything is drawn straight from the loopback rig's `World` and `Scene`, without its servers. Nothing here may be
changed to make a figure better; a new set gets a new name.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.board.lens import Lens, apply
from brushloop.calibrate.board.pix2len import local_scale
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.brush.brush import BrushSpec
from brushloop.drivers.sim.brush.footprint import PX_PER_MM as SHEET_PX_PER_MM
from brushloop.drivers.sim.config import SimConfig, View
from brushloop.drivers.sim.scene import Optics, Scene
from brushloop.drivers.sim.world import World
from brushloop.sessions.records import Stroke
from tests.calibrate.given import photographed

Gray = NDArray[np.uint8]
Floats = NDArray[np.float64]
INK = 0.5
"""Ink per area from which a place of the sheet counts as inked: half of what a full stroke has."""

BRUSHES = (
    BrushSpec(radius_mm=6.0, length_mm=48.0, stiffness_n_mm2=200.0, friction=0.22, set_deg=8.0, seed=11),
    BrushSpec(radius_mm=5.2, length_mm=44.0, stiffness_n_mm2=160.0, friction=0.18, set_deg=6.5, seed=12),
    BrushSpec(radius_mm=6.4, length_mm=51.0, stiffness_n_mm2=250.0, friction=0.26, set_deg=10.0, seed=13),
    BrushSpec(radius_mm=5.6, length_mm=46.0, stiffness_n_mm2=180.0, friction=0.20, set_deg=9.0, seed=14),
    BrushSpec(radius_mm=6.0, length_mm=50.0, stiffness_n_mm2=220.0, friction=0.24, set_deg=7.5, seed=15),
)
CAMERAS = (
    View(),
    View(k1=-0.08, shadow=0.20, noise=1.5, keystone=0.004, turn_deg=-1.0),
    View(k1=0.05, shadow=0.35, noise=3.0, keystone=0.020, turn_deg=1.2, shade=0.25),
    View(k1=-0.15, shadow=0.10, noise=2.5, px_per_mm=6.0, shade=0.30, blur_px=0.9),
    View(k1=-0.03, shadow=0.45, noise=1.0, keystone=0.010, turn_deg=-0.4, blur_px=0.5, px_per_mm=6.1),
)
HEIGHTS_MM = (11.0, 13.0, 15.0, 17.0, 20.0)
TILTS_DEG = (0.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True)
class Shot:
    """A photograph of a sheet, and what is true of it."""

    image: Gray
    optics: Optics
    board: BoardSpec
    anchors_mm: tuple[tuple[float, float], ...]
    """Where each press really touched, in the paper frame."""
    ink: NDArray[np.float32]
    """(rows, columns) ink per area of the sheet at 10 px/mm; row 0 is its far edge."""
    sheet_mm: tuple[float, float]


def aimed(view: View, rng: np.random.Generator) -> View:
    """The same camera, set up again: its place, turn and slant differ a little, its lens and light do not."""
    x, y = view.centre_mm
    return dataclasses.replace(
        view,
        centre_mm=(x + rng.uniform(-3.0, 3.0), y + rng.uniform(-3.0, 3.0)),
        turn_deg=view.turn_deg + rng.uniform(-0.3, 0.3),
        px_per_mm=view.px_per_mm * rng.uniform(0.99, 1.01),
        keystone=view.keystone + rng.uniform(-0.002, 0.002),
    )


def boards(rig: int, draws: int, seed: int = 0) -> Iterator[Shot]:
    """Blank sheets on the board, the camera aimed again for each."""
    for draw in range(draws):
        rng = np.random.default_rng([seed, rig, draw])
        config = SimConfig(seed=int(rng.integers(1, 2**30)), view=aimed(CAMERAS[rig], rng))
        yield _photographed(World(config), ())


def sheet(rig: int, presses: int, seed: int = 0) -> Shot:
    """One sheet with this many presses (at most 15, one of each H and alpha at most) by this rig's brush."""
    rng = np.random.default_rng([seed, rig, 10_000])
    config = SimConfig(seed=int(rng.integers(1, 2**30)), view=aimed(CAMERAS[rig], rng), brush=BRUSHES[rig])
    world = World(config)
    conditions = [(h, a) for h in HEIGHTS_MM for a in TILTS_DEG]
    anchors: list[tuple[float, float]] = []
    for index, number in enumerate(rng.permutation(len(conditions))[:presses]):
        depth_mm, tilt_deg = conditions[number]
        # 40 x 34 mm apart: no mark reaches into the window of another.
        place = (36.0 + 40.0 * (index % 5) + rng.uniform(-1, 1), 30.0 + 44.0 * (index // 5) + rng.uniform(-1, 1))
        mark = world.brush.press(depth_mm, tilt_deg, ink_load=rng.uniform(0.85, 1.0), press_seed=1000 * rig + index)
        world.paper.lay(mark, *place, 0.0)
        anchors.append(place)
    return _photographed(world, tuple(anchors))


def true_scale(shot: Shot, pixel: tuple[float, float]) -> float:
    """True mm per pixel at one pixel of the photograph as it was taken, by finite differences of the true optics."""
    camera, until = shot.optics.camera_matrix, (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)

    def to_paper(pixels: Floats) -> Floats:
        straight = cv2.undistortPointsIter(pixels[:, None], camera, shot.optics.distortion, np.eye(3), camera, until)
        return apply(np.linalg.inv(shot.optics.homography), straight.reshape(-1, 2))

    return local_scale(to_paper, np.array(pixel))


def true_mask(shot: Shot, window_mm: tuple[float, float, float, float], px_per_mm: float) -> NDArray[np.bool_]:
    """Which pixels of a window (x, y, width, height of the paper frame) hold ink, row 0 at its far edge."""
    x, y, width, height = window_mm
    step = SHEET_PX_PER_MM / px_per_mm
    left, top = x * SHEET_PX_PER_MM, (shot.sheet_mm[1] - y - height) * SHEET_PX_PER_MM
    move = np.array([[step, 0.0, left + 0.5 * step - 0.5], [0.0, step, top + 0.5 * step - 0.5]])
    size = (round(width * px_per_mm), round(height * px_per_mm))
    window = cv2.warpAffine(shot.ink, move, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    return np.asarray(window, np.float32) >= INK


def collected(folder: Path, shot: Shot, optics: Lens | None = None) -> Path:
    """The closed session of a shot: its board, then each press on a patch of its own, on the same photograph."""
    strokes = [
        Stroke(
            stroke_id=f"s{k}",
            kind="press",
            still=0,
            depth_mm=13.0,
            tilt_deg=5.0,
            anchor_mm=anchor,
            cell_mm=(anchor[0] - 30.0, anchor[1] - 12.0, 40.0, 24.0),
        )
        for k, anchor in enumerate(shot.anchors_mm)
    ]
    return photographed(folder, shot.board, [shot.image], [(stroke, shot.image) for stroke in strokes], optics=optics)


def _photographed(world: World, anchors: tuple[tuple[float, float], ...]) -> Shot:
    scene = Scene(world)
    world.version += 1
    table = world.config.table
    board = BoardSpec(**{name: getattr(table, f"board_{name}") for name in BoardSpec.model_fields})
    image = scene.render(brush_pose(*world.config.home_mm))  # the arm stands where it hides no corner
    return Shot(image, scene.optics, board, anchors, world.paper.density, table.sheet_mm)
