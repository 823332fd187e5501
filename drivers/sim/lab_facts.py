"""The facts of an unknown lab: what is true there, where its things are, how a seed draws them, what may go wrong."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Self

import numpy as np

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import DOWN, brush_pose, from_line, of_vector, product
from brushloop.drivers.sim.brush.brush import BrushSpec
from brushloop.drivers.sim.config import CORNERS, Place, SimConfig, Table, View
from brushloop.drivers.sim.kinematics import HOME, inverse, matrix_of
from brushloop.drivers.sim.scene import homography, mapped
from brushloop.drivers.sim.world import tool_of

CAMERA_PORTS = (8080, 8081)
PICTURE_PX = (1280, 960)
PRINTS = ((26, 20, 12.0, 9.0), (24, 19, 12.0, 9.0), (22, 17, 14.0, 10.5), (27, 20, 12.0, 9.0))
"""Boards that fit on A3: columns, rows, square and marker in mm."""
BRUSHES = ((5.5, 46.0), (6.0, 48.0), (6.5, 50.0))
LIFT_MM = 60.0
"""How far a person lifts the brush before going elsewhere."""
PIN_TILT_DEG = 38.0
UPRIGHT_ABOVE_MM = 70.0
DIP_ABOVE_BOTTOM_MM = 2.5
CLEAR_OF_PICTURE_MM = 75.0
"""More than the arm hides around the tip."""
BOARD_MARGIN_PX = 12.0
"""Least distance of the board from the edge of the picture: the lens distorts."""
CLEAR_APART_MM = 160.0
"""Between two places out of the picture."""
PRESS_SHARE = 0.45
"""Deepest press, as a share of the free length, that the maker of the brush allows."""
MOST_ROUNDS = 3.0
"""The sensor's rounds come faster with simulated time, up to this many times: what one process can send and read."""
BASE_CLEAR_MM = 230.0
"""Least distance from the axis of the base that a straight way may have."""


class Trap(StrEnum):
    """Its name on the command line."""

    SWAPPED_CORNER = "swapped-corner"
    """The person takes two neighbouring corners for each other."""
    MIRRORED_CAMERA = "mirrored-camera"
    """The camera's driver mirrors its picture."""
    WRONG_BOARD_SIZE = "wrong-board-size"
    """The board was printed to fit the page: its squares are smaller than the line below it says."""
    TCP_IN_METRES = "tcp-in-metres"
    """Somebody typed the tool at the pendant in metres, where it takes millimetres."""
    PARK_IN_PICTURE = "park-in-picture"
    """The person parks the arm where the camera sees it."""
    SLOW_CAMERA = "slow-camera"
    """The camera's pictures arrive 1.2 s late."""
    FORCE_SIGN = "force-sign"
    """The sensor reports the push of the brush on the paper, not the paper's on the brush."""
    SHEET_OUT_OF_REACH = "sheet-out-of-reach"
    """The far corners of the sheet lie beyond the arm's reach."""
    OLD_SOFTWARE = "old-software"
    """The cabinet has the software before ARCS: only its port 8899 answers."""
    CABLE_PULLED = "cable-pulled"
    """Somebody trips over the controller's network cable in the middle of a step."""


@dataclass(frozen=True, slots=True)
class Facts:
    """One lab. All numbers are the true ones; only tests may compare them with what was found."""

    config: SimConfig
    pin_mm: Place
    """Upper end of a pin that stands on the table."""
    wash_mm: tuple[float, float]
    """Centre of a pot of water like the well, in the paper frame."""
    park_mm: Place
    """A place for the tip outside the picture."""
    clear_mm: Place
    """Another one."""
    cabinet_tcp: tuple[float, ...]
    """Tool offset that somebody once typed at the pendant: x, y, z in m and three angles in rad."""
    payload_kg: float
    camera_port: int
    """Of the camera that shows the sheet."""
    printed_mm: tuple[float, float]
    """Sides of a square and of a marker that the line below the print states."""
    swapped: tuple[str, ...] = ()
    """Corners that the person takes for each other."""
    cable_after: int | None = None
    """Number of touched things after which somebody trips over the controller's cable."""
    speaks_arcs: bool = True
    """Whether the cabinet has the software that does."""

    @property
    def max_depth_mm(self) -> int:
        """Deepest press that the maker of the brush allows."""
        return round(PRESS_SHARE * self.config.brush.length_mm)

    def place(self, to: str, name: str = "") -> Place:
        """Where a person goes for a thing, such as the `name` of a corner. Raises ValueError for an unknown corner."""
        table = self.config.table
        if to in ("board-corner", "sheet-corner"):
            if name in self.swapped:
                name = self.swapped[1 - self.swapped.index(name)]
            return table.corner(to.removesuffix("-corner"), name)
        (x, y), (wash_x, wash_y) = table.well_mm, self.wash_mm
        return {
            "pin": self.pin_mm,
            "upright": table.over_sheet(UPRIGHT_ABOVE_MM),
            "well": table.to_base(x, y, DIP_ABOVE_BOTTOM_MM),
            "well-rim": table.to_base(x, y + table.well_radius_mm, table.well_depth_mm),
            "wash-pot": table.to_base(wash_x, wash_y, DIP_ABOVE_BOTTOM_MM),
            "wash-rim": table.to_base(wash_x, wash_y + table.well_radius_mm, table.well_depth_mm),
            "park": self.park_mm,
            "clear-view": self.clear_mm,
        }[to]

    def patched(self, **config: Any) -> Self:
        """The lab with these fields of its configuration changed."""
        return replace(self, config=replace(self.config, **config))


def held(place: Place, *, turn_deg: float = 0.0, tilt_deg: float = 0.0, toward_deg: float = 0.0) -> Pose:
    """The brush with its tip at a place, and then its ferrule leaned toward a direction.

    The wrist is turned from where a person would turn it, which is away from the foot of the arm. Unlike `brush_pose`,
    where it turns with the direction of the lean.
    """
    wrist = math.atan2(place[1], place[0]) + math.radians(turn_deg)
    toward, tilt = math.radians(toward_deg), math.radians(tilt_deg)
    lean = of_vector((-math.sin(toward) * tilt, math.cos(toward) * tilt, 0.0))
    return Pose(*place, *product(lean, product(of_vector((0.0, 0.0, wrist)), DOWN)))


def draw(seed: int, rate: float = 1.0, picture_px: tuple[int, int] = PICTURE_PX) -> Facts:
    """The lab of this seed: drawn again until the arm reaches everything and the camera sees the board."""

    def works(facts: Facts) -> bool:
        board = [facts.config.table.corner("board", name) for name in CORNERS]
        return in_picture(facts.config, board, BOARD_MARGIN_PX) and reaches(facts.config, poses(facts))

    rngs = (np.random.default_rng([seed, 16, attempt]) for attempt in itertools.count())
    guesses = (_guess(rng, seed, rate, picture_px) for rng in rngs)
    return next(facts for facts in guesses if facts is not None and works(facts))


def _guess(rng: np.random.Generator, seed: int, rate: float, picture_px: tuple[int, int]) -> Facts | None:
    table = _table(rng)
    view = _view(rng, table, picture_px)
    sideways_mm, at, lean_deg, toward = (float(rng.uniform(0, most)) for most in (15, math.tau, 3, math.tau))
    radius_mm, length_mm = BRUSHES[rng.integers(len(BRUSHES))]
    pin = _beside(rng, table, 50.0)
    wash = _beside(rng, table, 35.0)
    config = SimConfig(
        seed=seed,
        rate=rate,
        ink_device=("station", "pump", "none")[rng.integers(3)],
        tool_mm=float(rng.uniform(120, 260)),
        tool_sideways_mm=(sideways_mm * math.cos(at), sideways_mm * math.sin(at)),
        tool_lean_deg=(lean_deg * math.cos(toward), lean_deg * math.sin(toward)),
        sensor_turn_deg=float(rng.choice([0, 90, 180, 270]) + rng.normal(0.0, 2.0)),
        sensor_sign=1 if rng.random() < 0.75 else -1,
        brush=BrushSpec(seed=seed, radius_mm=radius_mm, length_mm=length_mm),
        table=table,
        view=view,
    )
    # The tool offset at the pendant is none, that of another tool, or this one measured with a ruler.
    ruler_m, other_m = (config.tool_mm + float(rng.normal(0.0, 2.0))) / 1e3, float(rng.uniform(0.05, 0.2))
    typed = ((0.0,) * 6, (0.0, 0.03, other_m, 0.0, 0.0, 0.5), (0.0, 0.0, ruler_m, 0.0, 0.0, 0.0))[rng.integers(3)]
    payload_kg, camera_port = float(rng.choice([0.0, 0.5])), CAMERA_PORTS[rng.integers(2)]
    park = next(_places_aside(rng, config, 40), None)
    if park is None or min(math.dist(pin, wash), math.dist(pin, table.well_mm), math.dist(wash, table.well_mm)) < 60.0:
        return None
    others = _places_aside(np.random.default_rng([seed, 43]), config, 400)
    clear = next((place for place in others if math.dist(park, place) >= CLEAR_APART_MM), None)
    if clear is None:
        return None
    return Facts(
        config=replace(config, home_mm=park, force_hz=config.force_hz * min(max(rate, 1.0), MOST_ROUNDS)),
        pin_mm=table.to_base(*pin, float(rng.uniform(20, 60))),
        wash_mm=wash,
        park_mm=park,
        clear_mm=clear,
        cabinet_tcp=typed,
        payload_kg=payload_kg,
        camera_port=camera_port,
        printed_mm=(table.board_square_mm, table.board_marker_mm),
    )


def _table(rng: np.random.Generator) -> Table:
    columns, rows, square_mm, marker_mm = PRINTS[rng.integers(len(PRINTS))]
    left, bottom, right, top = (float(v) for v in rng.integers(26, 41, 4))
    width, height = columns * square_mm - left - right, rows * square_mm - bottom - top
    reach_mm, bearing, yaw_deg = rng.uniform(400, 520), math.radians(rng.uniform(-110, 110)), float(rng.uniform(0, 360))
    yaw = math.radians(yaw_deg)
    table = Table(
        origin_mm=(
            float(reach_mm * math.cos(bearing) - math.cos(yaw) * width / 2 + math.sin(yaw) * height / 2),
            float(reach_mm * math.sin(bearing) - math.sin(yaw) * width / 2 - math.cos(yaw) * height / 2),
        ),
        yaw_deg=yaw_deg,
        paper_z_mm=float(rng.uniform(0, 160)),
        slope_deg=(float(rng.uniform(-1, 1)), float(rng.uniform(-1, 1))),
        sheet_mm=(width, height),
        board_origin_mm=(-left, -bottom),
        board_squares=(columns, rows),
        board_square_mm=square_mm,
        board_marker_mm=marker_mm,
        well_radius_mm=float(rng.uniform(12, 18)),
    )
    return replace(table, well_mm=_beside(rng, table, table.well_radius_mm + 12.0))


def _view(rng: np.random.Generator, table: Table, picture_px: tuple[int, int]) -> View:
    (width, height), (width_px, height_px) = table.board_size_mm, picture_px
    focal = float(rng.uniform(0.95, 1.25))
    across_mm = max(width + rng.uniform(30, 60), (height + rng.uniform(30, 60)) * width_px / height_px)
    left, bottom = table.board_origin_mm
    centre = (left + width / 2 + float(rng.uniform(-8, 8)), bottom + height / 2 + float(rng.uniform(-8, 8)))
    above_mm, aside, toward = focal * across_mm, rng.uniform(0, 0.1), rng.uniform(0, math.tau)
    return View(
        width_px=width_px,
        height_px=height_px,
        px_per_mm=width_px / float(across_mm),
        turn_deg=float(rng.uniform(-6, 6) + (180.0 if rng.random() < 0.3 else 0.0)),
        centre_mm=centre,
        lens_mm=(
            centre[0] + float(above_mm * aside * math.cos(toward)),
            centre[1] + float(above_mm * aside * math.sin(toward)),
            float(above_mm),
        ),
        focal=focal,
        noise=float(rng.uniform(1.5, 2.5)),
        shade=float(rng.uniform(0.05, 0.2)),
        k1=float(rng.uniform(-0.08, 0.04)),
        fps=float(rng.choice([10, 12, 15])),
        delay_s=float(rng.uniform(0.08, 0.6)),
        delay_jitter_s=float(rng.uniform(0.0, 0.03)),
    )


def _beside(rng: np.random.Generator, table: Table, clear_mm: float) -> tuple[float, float]:
    """A point beside the board, in the paper frame."""
    (width, height), (left, bottom) = table.board_size_mm, table.board_origin_mm
    along, beyond = float(rng.uniform(0.15, 0.85)), clear_mm + float(rng.uniform(0, 15))
    return (
        (left + along * width, bottom - beyond),
        (left + along * width, bottom + height + beyond),
        (left - beyond, bottom + along * height),
        (left + width + beyond, bottom + along * height),
    )[rng.integers(4)]


def _places_aside(rng: np.random.Generator, config: SimConfig, tries: int) -> Iterator[Place]:
    """Places that the arm reaches and the camera does not see, and a straight way from the sheet past the base."""
    table = config.table
    middle = table.over_sheet()
    for _ in range(tries):
        reach_mm = rng.uniform(300, 600)
        bearing = math.radians(math.degrees(math.atan2(middle[1], middle[0])) + rng.uniform(-80, 80))
        z_mm = table.paper_z_mm + float(rng.uniform(110, 180))
        place = (float(reach_mm * math.cos(bearing)), float(reach_mm * math.sin(bearing)), z_mm)
        base, sheet, aside = (brush_pose(x, y, 0.0) for x, y, _ in ((0.0, 0.0, 0.0), middle, place))
        if in_picture(config, [place]) or from_line(sheet, aside, base)[0] < BASE_CLEAR_MM:
            continue
        if abs(math.degrees(bearing)) < 150.0 and reaches(config, [brush_pose(*place)]):
            yield place


def in_picture(config: SimConfig, places: Sequence[Place], margin_px: float | None = None) -> bool:
    """Whether all places lie so far within the picture, lens distortion aside.

    By default, whether the arm with its tip at each of them hides a part of the picture.
    """
    view = config.view
    at_px = mapped(homography(view), np.array([config.table.to_paper(*place[:2]) for place in places]))
    least = -CLEAR_OF_PICTURE_MM * view.px_per_mm if margin_px is None else margin_px
    return bool(np.all((at_px > least) & (at_px < np.array([view.width_px, view.height_px]) - least)))


def poses(facts: Facts) -> Iterator[Pose]:
    """Poses of the tip that the lab must allow: by hand, and those of a later session, with room above."""
    table = facts.config.table
    board, sheet = ([table.corner(of, name) for name in CORNERS] for of in ("board", "sheet"))
    for place in (*board, *sheet, table.to_base(*facts.wash_mm), table.to_base(*table.well_mm)):
        upright = held(place)
        yield from (upright, replace(upright, z_mm=upright.z_mm + LIFT_MM + 20.0))
    for x, y, z in sheet:
        for turn_deg in (0.0, 90.0, 180.0, 270.0):
            yield brush_pose(x, y, z - 15.0, heading_deg=table.yaw_deg + turn_deg, tilt_deg=15.0)
    for toward_deg in range(0, 360, 45):
        yield held(facts.pin_mm, tilt_deg=PIN_TILT_DEG, toward_deg=toward_deg)


def reaches(config: SimConfig, wanted: Iterable[Pose]) -> bool:
    """Whether the arm reaches every pose of the tip with this tool."""
    tool, near = np.linalg.inv(tool_of(config)), HOME
    for pose in wanted:
        joints = inverse(matrix_of(pose) @ tool, near)
        if joints is None:
            return False
        near = joints
    return True


SHRUNK = 0.97
"""What `fit to page` does to an A3 page."""
SLOW_S = 1.2
TOO_FAR_MM = 330.0
"""How much farther away the sheet lies."""


def trapped(facts: Facts, trap: Trap) -> tuple[Facts, Facts]:
    """The lab with the trap in it, and as it is once the person has corrected the mistake."""
    table, view, rng = facts.config.table, facts.config.view, np.random.default_rng([facts.config.seed, 18])
    match trap:
        case Trap.SWAPPED_CORNER:
            first = int(rng.integers(4))
            return replace(facts, swapped=(CORNERS[first], CORNERS[(first + 1) % 4])), facts
        case Trap.MIRRORED_CAMERA:
            return facts.patched(view=replace(view, mirrored=True)), facts
        case Trap.WRONG_BOARD_SIZE:  # a board that was printed too small is measured
            square_mm, marker_mm = SHRUNK * table.board_square_mm, SHRUNK * table.board_marker_mm
            wrong = facts.patched(table=replace(table, board_square_mm=square_mm, board_marker_mm=marker_mm))
            return wrong, replace(wrong, printed_mm=(square_mm, marker_mm))
        case Trap.TCP_IN_METRES:
            return replace(facts, cabinet_tcp=(0.0, 0.0, facts.config.tool_mm / 1e6, 0.0, 0.0, 0.0)), facts
        case Trap.PARK_IN_PICTURE:
            return replace(facts, park_mm=table.over_sheet(facts.park_mm[2] - table.paper_z_mm)), facts
        case Trap.SLOW_CAMERA:
            return facts.patched(view=replace(view, delay_s=SLOW_S)), facts
        case Trap.FORCE_SIGN:
            return facts.patched(sensor_sign=-1), facts.patched(sensor_sign=1)
        case Trap.SHEET_OUT_OF_REACH:  # with board, pots and camera; the pin stays within reach
            x, y, _ = table.over_sheet()
            stretch = TOO_FAR_MM / math.hypot(x, y)
            origin_mm = (table.origin_mm[0] + stretch * x, table.origin_mm[1] + stretch * y)
            return facts.patched(table=replace(table, origin_mm=origin_mm)), facts
        case Trap.OLD_SOFTWARE:
            return replace(facts, speaks_arcs=False), facts
        case Trap.CABLE_PULLED:
            return replace(facts, cable_after=int(rng.integers(2, 7))), facts
