"""What the loopback cameras see: sheet, board, ink and tool in perspective, under uneven light with glare and noise."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import columns as axes
from brushloop.drivers.geometry import of_vector
from brushloop.drivers.sim.brush.paper import PX_PER_MM
from brushloop.drivers.sim.config import Table, View
from brushloop.drivers.sim.world import World

Floats = NDArray[np.float64]
SHADOW_SOFTNESS = 0.02
"""Width of the shadow's edge, as a share of the image."""


class Optics:
    """Projection of the paper plane to pixels, and the uneven light on the sheet."""

    def __init__(self, view: View, seed: int) -> None:
        self.homography = homography(view)
        self.light = _light(view, np.random.default_rng([seed, 11]))
        self.glare = _glare(view, self.homography) if view.glare else None
        self.camera_matrix = camera_matrix(view)
        self.distortion: Floats = np.array([view.k1, 0.0, 0.0, 0.0])
        self._map = self._undistorted_places(view) if view.k1 else None

    def image_of(self, paper_mm: Floats) -> Floats:
        """(n, 2) pixels (centres on integers) of (n, 2) points of the paper plane, distortion included."""
        undistorted = self.undistorted_image_of(paper_mm)
        rays = np.column_stack([undistorted, np.ones(len(undistorted))]) @ np.linalg.inv(self.camera_matrix).T
        none = np.zeros(3)
        distorted, _ = cv2.projectPoints(rays[:, None], none, none, self.camera_matrix, self.distortion)
        return np.asarray(distorted, np.float64).reshape(-1, 2)

    def undistorted_image_of(self, paper_mm: Floats) -> Floats:
        """The same as `image_of`, for a lens without distortion."""
        return mapped(self.homography, paper_mm)

    def distort(self, undistorted: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image as this lens would have taken it; the same if the lens is perfect."""
        if self._map is None:
            return undistorted
        distorted = cv2.remap(undistorted, self._map, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return cast("NDArray[np.uint8]", distorted)

    def _undistorted_places(self, view: View) -> NDArray[np.float32]:
        """(h, w, 2): for every pixel of the distorted image, its place in the undistorted one."""
        columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
        pixels = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        places = cv2.undistortPoints(pixels, self.camera_matrix, self.distortion, P=self.camera_matrix)
        return places.reshape(view.height_px, view.width_px, 2).astype(np.float32)


def mapped(homography: Floats, points: Floats) -> Floats:
    """(n, 2) points where a homography takes (n, 2) points."""
    return np.asarray(cv2.perspectiveTransform(points[None], homography)[0], np.float64)


def camera_matrix(view: View) -> Floats:
    """(3, 3) of the pinhole, in pixels; its principal point is the middle of the image."""
    f, cx, cy = view.focal * view.width_px, (view.width_px - 1) / 2, (view.height_px - 1) / 2
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def stance(view: View, lens_mm: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """(rotation (3, 3), translation (3,) in mm) from the paper frame to that of a camera at `lens_mm`.

    The camera looks at the middle of the view; without a turn its x axis lies over the paper's.
    """
    aim = np.array([*view.centre_mm, 0.0]) - lens_mm
    ahead = aim / np.linalg.norm(aim)
    across = np.array([1.0, 0.0, 0.0]) - ahead[0] * ahead
    across = across / np.linalg.norm(across)
    turn = math.radians(view.turn_deg)
    right = math.cos(turn) * across - math.sin(turn) * np.cross(ahead, across)
    rotation = np.asarray(np.stack([right, np.cross(ahead, right), ahead]), np.float64)
    return rotation, np.asarray(-rotation @ np.array(lens_mm), np.float64)


def homography(view: View) -> NDArray[np.float64]:
    """(3, 3) from the paper plane in mm to image pixels, pixel centres on integers; rows run against y."""
    if view.lens_mm is not None:
        rotation, shift = stance(view, view.lens_mm)
        return camera_matrix(view) @ np.column_stack([rotation[:, 0], rotation[:, 1], shift])
    turn = math.radians(view.turn_deg)
    cos, sin, s = math.cos(turn), math.sin(turn), view.px_per_mm
    x, y = view.centre_mm
    to_centre = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 1.0]])
    flat = np.array([[s * cos, -s * sin, 0.0], [-s * sin, -s * cos, 0.0], [0.0, 0.0, 1.0]])
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, view.keystone / view.height_px, 1.0]])
    to_image = np.array([[1.0, 0.0, view.width_px / 2], [0.0, 1.0, view.height_px / 2], [0.0, 0.0, 1.0]])
    return to_image @ tilt @ flat @ to_centre


def _light(view: View, rng: np.random.Generator) -> NDArray[np.float32]:
    x = np.linspace(0.0, 1.0, view.width_px, dtype=np.float32)
    y = np.linspace(0.0, 1.0, view.height_px, dtype=np.float32)[:, None]
    slope = 1.0 - view.shade * (0.6 * x + 0.4 * y) ** 2
    across = math.cos(angle := rng.uniform(0.0, 2.0 * math.pi)) * (x - 0.5) + math.sin(angle) * (y - 0.5)
    edge = rng.uniform(-0.1, 0.1)
    in_shadow = 1.0 / (1.0 + np.exp(-(across - edge) / SHADOW_SOFTNESS))
    return (slope * (1.0 - view.shadow * in_shadow)).astype(np.float32)


def _glare(view: View, paper_to_image: NDArray[np.float64]) -> NDArray[np.float32]:
    """Gray levels (h, w) that a lamp's reflection adds; the lens's distortion of it is left out."""
    u, v, scale = paper_to_image @ np.array([*view.glare_mm, 1.0])
    x, y = np.arange(view.width_px) - u / scale, np.arange(view.height_px)[:, None] - v / scale
    sigma_px = view.glare_sigma_mm * view.px_per_mm
    return (view.glare * np.exp(-0.5 * (x**2 + y**2) / sigma_px**2)).astype(np.float32)


PRINT_PX_PER_MM = 6.0
EDGE_MM = 5.0
"""White edge of the print around the board."""
WHITE, BLACK, BEHIND = 245, 20, 110
FINGER_MM = 9.0
"""Radius of the thumb that covers a little of the print at either side."""


@dataclass(frozen=True, slots=True)
class Held:
    """How a board is held, in the camera's frame: x right, y down, z ahead."""

    turn_deg: tuple[float, float, float]
    """Rotation vector from the camera's axes to the board's; zero is face on and upright."""
    centre_mm: tuple[float, float, float]


def held_picture(
    board: cv2.aruco.CharucoBoard, table: Table, view: View, optics: Optics, held: Held
) -> NDArray[np.float32]:
    """(h, w) float32 gray levels of the board in hand, under the light of the table."""
    size_x_mm, size_y_mm = (n * table.board_square_mm for n in table.board_squares)
    inner = board.generateImage((round(size_x_mm * PRINT_PX_PER_MM), round(size_y_mm * PRINT_PX_PER_MM)))
    edge = round(EDGE_MM * PRINT_PX_PER_MM)
    columns, rows = inner.shape[1] + 2 * edge, inner.shape[0] + 2 * edge
    paper = np.full((rows, columns), WHITE, np.uint8)
    paper[edge:-edge, edge:-edge] = np.where(np.asarray(inner) > 127, WHITE, BLACK)
    for column in (0, columns):
        cv2.circle(paper, (column, rows // 2), round(FINGER_MM * PRINT_PX_PER_MM), (150,), -1)
    # raster pixel centres -> mm from the middle of the board -> image
    s = 1.0 / PRINT_PX_PER_MM
    to_mm = np.array([[s, 0.0, -0.5 * s * (columns - 1)], [0.0, s, -0.5 * s * (rows - 1)], [0.0, 0.0, 1.0]])
    rx, ry, rz = (math.radians(turn_deg) for turn_deg in held.turn_deg)
    right, down, _ = axes(of_vector((rx, ry, rz)))
    plane = np.column_stack([right, down, held.centre_mm])
    flat = cv2.warpPerspective(
        paper, optics.camera_matrix @ plane @ to_mm, (view.width_px, view.height_px), borderValue=BEHIND
    )
    blurred = cv2.GaussianBlur(optics.distort(np.asarray(flat, np.uint8)), (0, 0), view.blur_px)
    return blurred.astype(np.float32) * optics.light


TABLE_GRAY = 120
PAPER_GRAY = 228
INK_REFLECTANCE = 0.06
TOOL_GRAY = 70
TOOL_CLEAR_MM = 60.0
"""Radius of the disc that the arm hides when it is over the sheet."""
FAR_WIDTHS = 2.5
NOISE_FIELDS = 4
MARGIN_MM = 15.0
"""Width of the strip of table drawn around the board."""


def board(table: Table) -> cv2.aruco.CharucoBoard:
    """The ChArUco board that the sheet lies on."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, table.board_dictionary))
    return cv2.aruco.CharucoBoard(table.board_squares, table.board_square_mm, table.board_marker_mm, dictionary)


class Scene:
    """Renders the world. The sheet is warped only when it has changed; each frame's noise differs from the last one's.

    While nothing changes in view, one of `NOISE_FIELDS` finished frames is reused.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        table, view = world.config.table, world.config.view
        self._origin_mm, self._size_mm = _extent(table)
        self._blank, self._noise = _draw(table, world.config.seed, view.noise, (view.height_px, view.width_px))
        self.optics = Optics(view, world.config.seed)
        self.paper_to_image = self.optics.homography
        self._plane_to_image = self._raster_to_image()
        self._finished: dict[int, tuple[tuple[int, int] | None, NDArray[np.uint8]]] = {}
        """By noise field: the place of the tool's disc, and the frame. Valid for the sheet as it is lit now."""
        self._without_tool: dict[int, NDArray[np.uint8]] = {}
        """By noise field: the frame without the tool. Valid for the sheet as it is lit now."""
        self._lit: NDArray[np.float32] | None = None
        self._lit_version: tuple[int, Held | None] = (-1, None)
        self._disc_of: tuple[Pose | None, tuple[int, int] | None] = None, None
        """The tool as it was last seen, and the place of its disc."""
        self._count = 0
        self.held: Held | None = None
        """The board that a person holds before the camera; it hides everything else."""

    def tool(self) -> Pose:
        """Pose of the tool now. Advances the world, so only the thread that owns the world may call it."""
        return self._world.tool()

    def render(self, tool: Pose | None = None) -> NDArray[np.uint8]:
        """A (height, width) gray image of the world now.

        With `tool` given it only reads the world, and may run in another thread. Do not write to the array: it is
        returned again while the picture does not change.
        """
        tool = tool or self.tool()
        config, held = self._world.config, self.held
        if self._lit is None or self._lit_version != (self._world.version, held):
            self._lit_version = self._world.version, held
            if held is None:
                self._lit = self._light_sheet()
            else:
                self._lit = held_picture(board(config.table), config.table, config.view, self.optics, held)
            self._finished.clear()
            self._without_tool.clear()
        field = self._count % NOISE_FIELDS
        self._count += 1
        if self._disc_of[0] != tool:
            self._disc_of = tool, self._tool_disc(tool)
        disc_px = None if held else self._disc_of[1]
        at_px, frame = self._finished.get(field, (None, None))
        if frame is None or at_px != disc_px:
            frame = self._sheet_alone(field, self._lit)
            if disc_px is not None:
                frame = frame.copy()
                cv2.circle(frame, disc_px, self._disc_radius_px, (TOOL_GRAY,), -1)
                frame.flags.writeable = False
            if config.view.mirrored:
                frame = np.ascontiguousarray(frame[:, ::-1])
            self._finished[field] = disc_px, frame
        return frame

    def _sheet_alone(self, field: int, lit: NDArray[np.float32]) -> NDArray[np.uint8]:
        """The frame without the tool, made once for each sheet: a moving tool only hides part of it."""
        frame = self._without_tool.get(field)
        if frame is None:
            image = lit + self._noise[field]
            np.clip(image, 0.0, 255.0, out=image)
            frame = image.astype(np.uint8)
            frame.flags.writeable = False
            self._without_tool[field] = frame
        return frame

    def _raster_to_image(self) -> NDArray[np.float64]:
        # raster pixel centres (cv2 convention) -> mm in the paper frame -> image
        s = 1.0 / PX_PER_MM
        top_mm = self._origin_mm[1] + self._size_mm[1]
        to_mm = np.array([[s, 0, self._origin_mm[0] + 0.5 * s], [0, -s, top_mm - 0.5 * s], [0, 0, 1]])
        return self.paper_to_image @ to_mm

    def _light_sheet(self) -> NDArray[np.float32]:
        table, view = self._world.config.table, self._world.config.view
        raster = self._blank.copy()
        rows, columns = _sheet_slices(table)
        kept = 1.0 - (1.0 - INK_REFLECTANCE) * self._world.paper.density
        raster[rows, columns] = (raster[rows, columns] * kept).astype(np.uint8)
        warped = cv2.warpPerspective(
            raster,
            self._plane_to_image,
            (view.width_px, view.height_px),
            flags=cv2.INTER_LINEAR,
            borderValue=TABLE_GRAY,
        )
        blurred = cv2.GaussianBlur(self.optics.distort(warped.astype(np.uint8)), (0, 0), view.blur_px)
        lit = blurred.astype(np.float32) * self.optics.light
        return lit if self.optics.glare is None else lit + self.optics.glare

    @property
    def _disc_radius_px(self) -> int:
        return round(TOOL_CLEAR_MM * self._world.config.view.px_per_mm)

    def _tool_disc(self, tool: Pose) -> tuple[int, int] | None:
        """Pixel at the centre of the disc that the arm hides; None if all of it lies outside the image."""
        view, radius_px = self._world.config.view, self._disc_radius_px
        x_mm, y_mm = self._world.to_paper(tool.x_mm, tool.y_mm)
        at_mm = np.array([[x_mm, y_mm]])
        if np.abs(self.optics.undistorted_image_of(at_mm)).max() > FAR_WIDTHS * view.width_px:
            return None  # so far outside, the formula of the distortion leads back into the image
        [[u, v]] = self.optics.image_of(at_mm)
        u_px, v_px = round(float(u)), round(float(v))
        beside = max(-u_px, u_px - view.width_px, -v_px, v_px - view.height_px) > radius_px + 1
        return None if beside else (u_px, v_px)


def _extent(table: Table) -> tuple[tuple[float, float], tuple[float, float]]:
    """Lower left corner, in the paper frame, and size of what is drawn, in mm: the board and a margin of table."""
    left, bottom = (v - MARGIN_MM for v in table.board_origin_mm)
    across, along = (n * table.board_square_mm + 2 * MARGIN_MM for n in table.board_squares)
    return (left, bottom), (across, along)


def _sheet_slices(table: Table) -> tuple[slice, slice]:
    """Rows and columns of the sheet in the drawn raster."""
    (left_mm, bottom_mm), (_, along_mm) = _extent(table)
    top = round((along_mm - (table.sheet_mm[1] - bottom_mm)) * PX_PER_MM)
    left = round(-left_mm * PX_PER_MM)
    width, height = (round(v * PX_PER_MM) for v in table.sheet_mm)
    return slice(top, top + height), slice(left, left + width)


@functools.lru_cache(maxsize=2)
def _draw(
    table: Table, seed: int, noise: float, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], list[NDArray[np.float32]]]:
    """The blank sheet on its board, and fields of noise of `shape`: the same for every rig of this configuration."""
    rng = np.random.default_rng([seed, 7])
    (left_mm, bottom_mm), size_mm = _extent(table)
    width, height = (round(v * PX_PER_MM) for v in size_mm)
    raster = np.full((height, width), TABLE_GRAY, np.uint8)
    fibre = cv2.GaussianBlur(rng.normal(0.0, 6.0, (height, width)).astype(np.float32), (0, 0), 3.0)
    board_px = tuple(round(n * table.board_square_mm * PX_PER_MM) for n in table.board_squares)
    x, y = table.board_origin_mm
    top = round((size_mm[1] - (y - bottom_mm)) * PX_PER_MM) - board_px[1]
    column = round((x - left_mm) * PX_PER_MM)
    margin = round(3.0 * PX_PER_MM)
    raster[top - margin : top + board_px[1] + margin, column - margin : column + board_px[0] + margin] = 245
    picture = board(table).generateImage((board_px[0], board_px[1]))
    raster[top : top + board_px[1], column : column + board_px[0]] = np.where(picture > 127, 245, 20)
    rows, columns = _sheet_slices(table)
    raster[rows, columns] = np.clip(PAPER_GRAY + fibre[rows, columns], 0, 255).astype(np.uint8)
    return raster, [rng.normal(0.0, noise, shape).astype(np.float32) for _ in range(NOISE_FIELDS)]


WIDTH_PX, HEIGHT_PX = 640, 480
WALL, WALL_NOISE = 185, 2.0


class Wall:
    """What a second camera of a lab sees: a wall, and no sheet."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._noise = np.random.default_rng([world.config.seed, 17])

    def tool(self) -> Pose:
        """Pose of the tool now."""
        return self._world.tool()

    def render(self, tool: Pose | None = None) -> NDArray[np.uint8]:
        """A (480, 640) gray image."""
        return self._noise.normal(WALL, WALL_NOISE, (HEIGHT_PX, WIDTH_PX)).astype(np.uint8)
