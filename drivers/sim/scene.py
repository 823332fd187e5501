"""The loopback cameras: what they see, in perspective, under uneven light with glare and noise, and the streams of it.

A stream is MJPEG over HTTP, one new image per period to every client that keeps up.
"""

import asyncio
import functools
import itertools
import math
import random
import time
from collections import deque
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.drivers.camera.source import LOOPBACK_SERVER
from brushloop.drivers.devices import Pose
from brushloop.drivers.geometry import columns as axes
from brushloop.drivers.loopback import LoopbackServer
from brushloop.drivers.sim.brush.footprint import PX_PER_MM
from brushloop.drivers.sim.config import Table, View
from brushloop.drivers.sim.faults import Device, FaultBoard
from brushloop.drivers.sim.world import World

Floats = NDArray[np.float64]


class Optics:
    """Projection of the paper plane to pixels, and the uneven light on the sheet."""

    def __init__(self, view: View, seed: int) -> None:
        self.homography = homography(view)
        self.light = _light(view, np.random.default_rng([seed, 11]))
        self.camera_matrix = camera_matrix(view)
        self.distortion: Floats = np.array([view.k1, 0.0, 0.0, 0.0])
        self._map = None
        """(h, w, 2): for every pixel of the distorted image, its place in the undistorted one."""
        if view.k1:
            pinhole, size = self.camera_matrix, (view.width_px, view.height_px)
            kept = np.eye(3)  # the picture is not turned
            self._map, _ = cv2.initInverseRectificationMap(pinhole, self.distortion, kept, pinhole, size, cv2.CV_32FC2)

    def image_of(self, paper_mm: Floats) -> Floats:
        """(n, 2) pixels (centres on integers) of (n, 2) points of the paper plane, distortion included."""
        undistorted = mapped(self.homography, paper_mm)
        rays = np.column_stack([undistorted, np.ones(len(undistorted))]) @ np.linalg.inv(self.camera_matrix).T
        none = np.zeros(3)
        distorted, _ = cv2.projectPoints(rays[:, None], none, none, self.camera_matrix, self.distortion)
        return np.asarray(distorted, np.float64).reshape(-1, 2)

    def distort(self, undistorted: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """An image as this lens would have taken it; the same if the lens is perfect."""
        if self._map is None:
            return undistorted
        distorted = cv2.remap(undistorted, self._map, np.empty(0), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(distorted, np.uint8)


def mapped(homography: Floats, points: Floats) -> Floats:
    """(n, 2) points where a homography takes (n, 2) points."""
    return np.asarray(cv2.perspectiveTransform(points[None], homography)[0], np.float64)


def camera_matrix(view: View) -> Floats:
    """(3, 3) of the pinhole, in pixels; its principal point is the middle of the image."""
    f, cx, cy = view.focal * view.width_px, (view.width_px - 1) / 2, (view.height_px - 1) / 2
    return np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]])


def homography(view: View) -> Floats:
    """(3, 3) from the paper plane in mm to image pixels, pixel centres on integers; rows run against y.

    A lens over the sheet looks at the middle of the view; without a turn its x axis lies over the paper's.
    """
    turn = math.radians(view.turn_deg)
    cos, sin, s = math.cos(turn), math.sin(turn), view.px_per_mm
    x, y = view.centre_mm
    if view.lens_mm is not None:
        aim = np.array([x, y, 0.0]) - view.lens_mm
        ahead = aim / np.linalg.norm(aim)
        across = np.array([1.0, 0.0, 0.0]) - ahead[0] * ahead
        across = across / np.linalg.norm(across)
        right = cos * across - sin * np.cross(ahead, across)
        rotation = np.stack([right, np.cross(ahead, right), ahead])
        shift = -rotation @ np.array(view.lens_mm)
        return np.asarray(camera_matrix(view) @ np.column_stack([rotation[:, :2], shift]), np.float64)
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
    in_shadow = 1.0 / (1.0 + np.exp(-(across - edge) / 0.02))  # its edge is soft over 2 % of the image
    return (slope * (1.0 - view.shadow * in_shadow)).astype(np.float32)


PRINT_PX_PER_MM = 6.0
EDGE_MM, TRIMMED_EDGE_MM = 5.0, 3.0
"""White edge of the print around the board: in hand, and under the sheet."""
WHITE, BLACK, BEHIND = 245, 20, 110
FINGER_MM = 9.0
"""Radius of the thumb that covers a little of the print at either side."""
TABLE_GRAY = 120
PAPER_GRAY = 228
INK_REFLECTANCE = 0.06
TOOL_GRAY = 70
TOOL_CLEAR_MM = 60.0
"""Radius of the disc that the arm hides when it is over the sheet."""
NOISE_FIELDS = 4
MARGIN_MM = 15.0
"""Width of the strip of table drawn around the board."""


def board(table: Table) -> cv2.aruco.CharucoBoard:
    """The ChArUco board that the sheet lies on."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, table.board_dictionary))
    return cv2.aruco.CharucoBoard(table.board_squares, table.board_square_mm, table.board_marker_mm, dictionary)


class Scene:
    """Renders the world. The sheet is warped only when it has changed; each frame's noise differs from the last one's.

    While nothing changes and the tool is out of the picture, one of `NOISE_FIELDS` frames is returned again.
    """

    def __init__(self, world: World) -> None:
        self._world = world
        view = world.config.view
        self.optics = Optics(view, world.config.seed)
        self._shown: tuple[int, Pose | None] = (-1, None)
        self._lit: NDArray[np.float32] = np.zeros(0, np.float32)
        """The picture without noise and tool, of the sheet and the held board in `_shown`."""
        self._frames: dict[int, NDArray[np.uint8]] = {}
        """`_lit` with each field of noise: a moving tool only hides a part of it."""
        self._fields = itertools.cycle(range(NOISE_FIELDS))
        self._disc_radius_px = round(TOOL_CLEAR_MM * view.px_per_mm)
        self.held: Pose | None = None
        """The board before the camera, which hides the rest, in the frame of the camera: x right, y down, z ahead."""

    @functools.cached_property
    def _drawn(self) -> tuple[NDArray[np.uint8], list[NDArray[np.float32]]]:
        config, view = self._world.config, self._world.config.view
        return _draw(config.table, config.seed, view.noise, (view.height_px, view.width_px))

    def render(self, tool: Pose) -> NDArray[np.uint8]:
        """A (height, width) gray image of the world now, the tool at this pose; it may run in another thread.

        Do not write to the array: it is returned again while the picture does not change.
        """
        held = self.held
        if self._shown != (self._world.version, held):
            self._shown = self._world.version, held
            self._lit = self._light_sheet() if held is None else self._light_board(held)
            self._frames.clear()
        field = next(self._fields)
        if field not in self._frames:
            self._frames[field] = self._exposed(self._lit + self._drawn[1][field])
        frame = self._frames[field]
        disc_px = None if held else self._tool_disc(tool)
        if disc_px is not None:
            frame = frame.copy()
            cv2.circle(frame, disc_px, self._disc_radius_px, (TOOL_GRAY,), -1)
        return frame

    def _exposed(self, gray: NDArray[np.float32]) -> NDArray[np.uint8]:
        """A picture that nobody can write to, as the camera's driver delivers it."""
        frame = np.clip(gray, 0.0, 255.0).astype(np.uint8)
        if self._world.config.view.mirrored:
            frame = np.ascontiguousarray(frame[:, ::-1])
        frame.flags.writeable = False
        return frame

    def _light_sheet(self) -> NDArray[np.float32]:
        table = self._world.config.table
        raster = self._drawn[0].copy()
        sheet = _sheet_slices(table)
        kept = 1.0 - (1.0 - INK_REFLECTANCE) * self._world.paper.density
        raster[sheet] = (raster[sheet] * kept).astype(np.uint8)
        # raster pixel centres (cv2 convention) -> mm in the paper frame -> image
        (left_mm, top_mm), s = _upper_left_mm(table), 1.0 / PX_PER_MM
        to_mm = np.array([[s, 0, left_mm + 0.5 * s], [0, -s, top_mm - 0.5 * s], [0, 0, 1]])
        return self._photograph(raster, self.optics.homography @ to_mm, TABLE_GRAY)

    def _light_board(self, held: Pose) -> NDArray[np.float32]:
        """The print in hand, under the light of the table."""
        paper = _print(self._world.config.table, PRINT_PX_PER_MM, EDGE_MM)
        rows, columns = paper.shape
        for column in (0, columns):
            cv2.circle(paper, (column, rows // 2), round(FINGER_MM * PRINT_PX_PER_MM), (150,), -1)
        # raster pixel centres -> mm from the middle of the board -> image
        s = 1.0 / PRINT_PX_PER_MM
        to_mm = np.array([[s, 0.0, -0.5 * s * (columns - 1)], [0.0, s, -0.5 * s * (rows - 1)], [0.0, 0.0, 1.0]])
        right, down, _ = axes(held.quaternion)
        plane = np.column_stack([right, down, held.position_mm])
        return self._photograph(paper, self.optics.camera_matrix @ plane @ to_mm, BEHIND)

    def _photograph(self, raster: NDArray[np.uint8], to_image: Floats, around_gray: int) -> NDArray[np.float32]:
        """(h, w) gray levels of a flat raster through the lens, under the light of the table."""
        view = self._world.config.view
        size = view.width_px, view.height_px
        flat = cv2.warpPerspective(raster, to_image, size, flags=cv2.INTER_LINEAR, borderValue=around_gray)
        blurred = cv2.GaussianBlur(self.optics.distort(np.asarray(flat, np.uint8)), (0, 0), view.blur_px)
        return blurred.astype(np.float32) * self.optics.light

    def _tool_disc(self, tool: Pose) -> tuple[int, int] | None:
        """Pixel at the centre of the disc that the arm hides; None if all of it lies outside the image."""
        view = self._world.config.view
        at_mm = np.array([self._world.config.table.to_paper(tool.x_mm, tool.y_mm)])
        if np.abs(mapped(self.optics.homography, at_mm)).max() > 2.5 * view.width_px:
            return None  # so far outside, the formula of the distortion leads back into the image
        [[u, v]] = self.optics.image_of(at_mm)
        u_px, v_px = round(float(u)), round(float(v))
        beside_px = max(-u_px, u_px - view.width_px, -v_px, v_px - view.height_px)
        column_px = view.width_px - 1 - u_px if view.mirrored else u_px
        return None if beside_px > self._disc_radius_px + 1 else (column_px, v_px)


def _print(table: Table, px_per_mm: float, edge_mm: float) -> NDArray[np.uint8]:
    """The printed board with its white edge."""
    width_px, height_px = (round(n * table.board_square_mm * px_per_mm) for n in table.board_squares)
    picture = np.asarray(board(table).generateImage((width_px, height_px)))
    inked = np.where(picture > 127, WHITE, BLACK).astype(np.uint8)
    return np.pad(inked, round(edge_mm * px_per_mm), constant_values=WHITE)


def _upper_left_mm(table: Table) -> tuple[float, float]:
    """The corner of what is drawn, in the paper frame: the board and a margin of table."""
    (left, bottom), (_, height) = table.board_origin_mm, table.board_size_mm
    return left - MARGIN_MM, bottom + height + MARGIN_MM


def _sheet_slices(table: Table) -> tuple[slice, slice]:
    """Rows and columns of the sheet in the drawn raster."""
    left_mm, top_mm = _upper_left_mm(table)
    width, height = (round(v * PX_PER_MM) for v in table.sheet_mm)
    top, left = round((top_mm - table.sheet_mm[1]) * PX_PER_MM), round(-left_mm * PX_PER_MM)
    return slice(top, top + height), slice(left, left + width)


@functools.lru_cache(maxsize=2)
def _draw(
    table: Table, seed: int, noise: float, shape: tuple[int, int]
) -> tuple[NDArray[np.uint8], list[NDArray[np.float32]]]:
    """The blank sheet on its board, and fields of noise of `shape`: the same for every rig of this configuration."""
    rng = np.random.default_rng([seed, 7])
    around_px = round((MARGIN_MM - TRIMMED_EDGE_MM) * PX_PER_MM)
    raster = np.pad(_print(table, PX_PER_MM, TRIMMED_EDGE_MM), around_px, constant_values=TABLE_GRAY)
    fibre = cv2.GaussianBlur(rng.normal(0.0, 6.0, raster.shape).astype(np.float32), (0, 0), 3.0)
    sheet = _sheet_slices(table)
    raster[sheet] = np.clip(PAPER_GRAY + fibre[sheet], 0, 255).astype(np.uint8)
    return raster, [rng.normal(0.0, noise, shape).astype(np.float32) for _ in range(NOISE_FIELDS)]


def black(jpeg: bytes) -> bytes:
    """A picture of the same size as taken with the lens cap on, other than the one before."""
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    covered = np.random.default_rng().integers(0, 6, image.shape, np.uint8)  # not quite black
    return cv2.imencode(".jpg", covered)[1].tobytes()


def renumbered(jpeg: bytes, number: int) -> bytes:
    """The same picture with other bytes: a JPEG comment with a number is inserted after the two start bytes."""
    text = b"%d" % number
    comment = b"\xff\xfe" + (len(text) + 2).to_bytes(2, "big") + text
    return jpeg[:2] + comment + jpeg[2:]


def torn(jpeg: bytes) -> bytes:
    """The first half with a valid end mark: the rest never arrived."""
    return jpeg[: len(jpeg) // 2] + b"\xff\xd9"


SPOILED: dict[str, Callable[[bytes], bytes]] = {"black": black, "torn": torn}
"""Faults of a single picture: JPEG in, JPEG out."""
BOUNDARY = "brushloop"
JPEG_QUALITY = 95

Render = Callable[[Pose], NDArray[np.uint8]]
"""The gray image of a camera, with the tool at this pose; called in another thread than the world's."""


class MjpegServer(LoopbackServer):
    """Serves `/stream.mjpg`. A client that reads too slowly is sent the newest image next, never a backlog."""

    def __init__(self, world: World, render: Render, faults: FaultBoard | None = None) -> None:
        super().__init__()
        self._world = world
        self._render = render
        self._rendering = asyncio.Lock()
        self._coded: deque[tuple[NDArray[np.uint8], bytes]] = deque(maxlen=NOISE_FIELDS)
        """The newest images and their JPEGs, reused while nothing changes."""
        self._faults = faults

    async def converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer any request with the stream."""
        async with asyncio.timeout(5.0):
            await reader.readuntil(b"\r\n\r\n")
        writer.write(
            b"HTTP/1.0 200 OK\r\nCache-Control: no-store\r\nServer: " + LOOPBACK_SERVER.encode() + b"\r\n"
            b"Content-Type: multipart/x-mixed-replace; boundary=" + BOUNDARY.encode() + b"\r\n\r\n"
        )
        loop = asyncio.get_running_loop()
        due_s = sent_s = loop.time()
        shown = b""
        while not writer.is_closing():  # a late picture is not drained, which would notice
            kind = None if self._faults is None else self._faults.kind_met(Device.CAMERA)
            exposed_s, image = await self._exposed()
            if kind == "frozen":
                image = renumbered(shown or image, time.time_ns())
            elif kind in SPOILED:
                image = SPOILED[kind](image)
            else:
                shown = image
            # The delay includes the time to draw, and no picture overtakes another.
            view = self._world.config.view
            delay_s = view.delay_s + random.uniform(0.0, view.delay_jitter_s)
            sent_s = max(sent_s + 1e-6, exposed_s + delay_s)  # timers with the same time run in any order
            head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(image)}\r\n\r\n"
            loop.call_at(sent_s, self.write, writer, head.encode() + image + b"\r\n")
            await writer.drain()  # of earlier pictures: else a slow client would fall farther and farther behind
            due_s = max(due_s + 1.0 / view.fps, loop.time())
            await asyncio.sleep(due_s - loop.time())

    async def _exposed(self) -> tuple[float, bytes]:
        """A new picture: the loop's time at its exposure, and its JPEG."""
        async with self._rendering:  # the scene keeps a cache: one thread at a time
            tool = self._world.tool()  # here, because the motion queue belongs to the event loop's thread
            return asyncio.get_running_loop().time(), await asyncio.to_thread(self._jpeg, tool)

    def _jpeg(self, tool: Pose) -> bytes:
        image = self._render(tool)
        for coded, data in self._coded:
            if coded is image:
                return data
        _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        self._coded.append((image, data := encoded.tobytes()))
        return data
