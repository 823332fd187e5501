"""What a person aims at when asked for a thing: the pose of the brush, with the errors that a hand makes."""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from brushloop.drivers.samples import Pose
from brushloop.drivers.sim.camera.held import Held
from brushloop.drivers.sim.camera.optics import Floats
from brushloop.drivers.sim.lab.facts import PIN_TILT_DEG, Facts
from brushloop.drivers.sim.lab.places import Place, azimuth_deg, board_size_mm, corner, held, in_base, over_sheet

TOUCHED = ("pin", "board-corner", "sheet-corner", "well-rim", "wash-rim")
"""Things that the tip touches; it is brought to the others by eye."""
BY_EYE_MM = 1.0
"""Standard deviation of a tip that is brought near a thing by eye, along each axis."""
SEEN_SIGMAS = 2.5
"""Errors beyond this many standard deviations are seen and corrected by the person."""
UPRIGHT_DEG = 1.0
"""Standard deviation of a brush that is held upright by eye, about either axis."""
SQUARE_DEG = 0.15
"""The same for a brush that is held upright against a set square."""
DIP_ABOVE_BOTTOM_MM = 2.5
UPRIGHT_ABOVE_MM = 70.0


@dataclass(frozen=True, slots=True)
class Way:
    """A way to hold the board: its slant and the side toward which it slants, its turn in the picture, its place."""

    slant_deg: float = 0.0
    toward_deg: float = 0.0
    turn_deg: float = 0.0
    aside: tuple[float, float] = (0.0, 0.0)
    """Right and down, in shares of the picture's width and height."""


HELD = (
    Way(3.0),
    *(Way(28.0, toward) for toward in (270.0, 90.0, 0.0, 180.0)),
    Way(22.0, 45.0, 0.0, (-0.17, -0.17)),
    Way(22.0, 135.0, 0.0, (0.17, -0.17)),
    Way(22.0, 225.0, 0.0, (0.17, 0.17)),
    Way(22.0, 315.0, 0.0, (-0.17, 0.17)),
    Way(25.0, 60.0, 90.0),
)
"""How a person is asked to hold it: flat, slanted to each side, in the four corners, and turned by a quarter."""


def _any_way(rng: np.random.Generator) -> Way:
    x, y, toward = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0, 360)
    return Way(float(rng.uniform(18, 30)), float(toward), 0.0, (float(x), float(y)))


class Aims:
    """The person's aims in one lab. An error depends on the seed, the thing, and how often it was asked for."""

    def __init__(self, facts: Callable[[], Facts]) -> None:
        self._facts = facts
        self._asked: Counter[str] = Counter()

    def tip(self, to: str, index: int, name: str) -> Pose:
        """Pose of the tip for a thing. Raises ValueError for one that the lab does not have."""
        facts, rng = self._facts(), self._drawn(to, index, name)
        place = self._place(facts, to, name)
        wrist_deg = azimuth_deg(place) + float(rng.normal(0.0, 5.0))
        tilt_deg, toward_deg = 0.0, 0.0
        if to == "pin":
            tilt_deg, toward_deg, wrist_deg = self._pin(index, wrist_deg, rng)
        elif to == "upright":
            wrist_deg += (0.0, 100.0, -100.0, 50.0, -50.0)[index % 5]
        spread_mm = facts.hand_mm if to in TOUCHED else BY_EYE_MM
        x, y, z = (float(v) for v in np.array(place) + _error_mm(rng, spread_mm))
        aimed = held((x, y, z), wrist_deg=wrist_deg, tilt_deg=tilt_deg, toward_deg=toward_deg)
        return _unsteady(aimed, SQUARE_DEG if to == "upright" else UPRIGHT_DEG, rng)

    def board(self, index: int) -> Held:
        """How the board is held before the camera: each time at another slant and in another part of the picture."""
        facts, rng = self._facts(), self._drawn("hold-board", index, "")
        view, table = facts.config.view, facts.config.table
        pose = HELD[index] if index < len(HELD) else _any_way(rng)
        size_x_mm, size_y_mm = board_size_mm(table)
        high = view.height_px / view.width_px
        longest = max(size_x_mm, size_y_mm / high) if abs(pose.turn_deg) < 45.0 else max(size_y_mm, size_x_mm / high)
        across_mm = longest / float(rng.uniform(0.85, 0.95))
        toward = math.radians(pose.toward_deg + float(rng.uniform(-15, 15)))
        slant_deg = pose.slant_deg + float(rng.uniform(-3, 3))
        in_picture = Rotation.from_euler("z", pose.turn_deg + float(rng.normal(0.0, 4.0)), degrees=True)
        axis = slant_deg * np.array([math.cos(toward), math.sin(toward), 0.0])
        turn = Rotation.from_rotvec(axis, degrees=True) * in_picture
        rx, ry, rz = (float(v) for v in turn.as_rotvec(degrees=True))
        x, y = pose.aside
        return Held((rx, ry, rz), (x * across_mm, y * across_mm * high, view.focal * across_mm))

    def _pin(self, index: int, wrist_deg: float, rng: np.random.Generator) -> tuple[float, float, float]:
        """(tilt, its direction, wrist) in deg. The brush leans to each of four sides in turn; in every second round the
        sides lie between those of the first, and from round to round the wrist turns."""
        tilt_deg = PIN_TILT_DEG + float(rng.uniform(-4, 0))
        toward_deg = 90.0 * index + 45.0 * (index // 4 % 2) + float(rng.uniform(-8, 8))
        return tilt_deg, toward_deg, wrist_deg + (0.0, 70.0, -70.0)[index // 4 % 3]

    def _place(self, facts: Facts, to: str, name: str) -> Place:
        table = facts.config.table
        match to:
            case "pin":
                return facts.pin_mm
            case "board-corner" | "sheet-corner":
                return corner(table, to.removesuffix("-corner"), self._meant(facts, name))
            case "well":
                return in_base(table, *table.well_mm, DIP_ABOVE_BOTTOM_MM)
            case "well-rim" | "wash-rim":
                x, y = table.well_mm if to == "well-rim" else facts.wash_mm
                return in_base(table, x, y + table.well_radius_mm, table.well_depth_mm)
            case "wash-pot":
                return in_base(table, *facts.wash_mm, DIP_ABOVE_BOTTOM_MM)
            case "park" if facts.parks_in_picture:
                return over_sheet(table, facts.park_mm[2] - table.paper_z_mm)
            case "park":
                return facts.park_mm
            case "clear-view":
                return facts.clear_mm
            case "upright":
                return over_sheet(table, UPRIGHT_ABOVE_MM)
            case _:
                raise ValueError(f"to = {to!r}: there is no such thing in this lab")

    def _meant(self, facts: Facts, name: str) -> str:
        """The corner that the person takes for the one that was asked for."""
        words = " ".join(name.replace("-", " ").replace("_", " ").split())
        if facts.swapped is not None and words in facts.swapped:
            return facts.swapped[1 - facts.swapped.index(words)]
        return words

    def _drawn(self, to: str, index: int, name: str) -> np.random.Generator:
        key = f"{to} {index} {name}"
        self._asked[key] += 1
        return np.random.default_rng([self._facts().seed, 31, zlib.crc32(key.encode()), self._asked[key]])


def _error_mm(rng: np.random.Generator, spread_mm: float) -> Floats:
    """(3,) normal error along each axis; drawn again while it is larger than what a person would see and correct."""
    while True:
        error = rng.normal(0.0, spread_mm, 3)
        if np.abs(error).max() <= SEEN_SIGMAS * spread_mm:
            return error


def _unsteady(pose: Pose, spread_deg: float, rng: np.random.Generator) -> Pose:
    """The pose with a small random rotation of the brush about its tip."""
    lean = Rotation.from_rotvec([*rng.normal(0.0, spread_deg, 2), 0.0], degrees=True)
    qx, qy, qz, qw = (float(v) for v in (lean * Rotation.from_quat(pose.quaternion)).as_quat())
    return Pose(*pose.position_mm, qx, qy, qz, qw)
