"""A lens (OpenCV's five-parameter model) and its distortion; and the fit of a lens to photographs of a board.

A fit says what each photograph contributes, which ones do not fit, and what else to photograph.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Artefact, Frozen, made_by
from brushloop.calibrate.board.spec import BoardView
from brushloop.calibrate.errors import CalibrationError, CaptureRefused

Gray = NDArray[np.uint8]
Floats = NDArray[np.float64]
FITTED = "k1 fitted on the board"
"""Source of a lens where no lens file was given and none was needed."""
LEAST_VIEWS = 4
GOOD_VIEWS = 10
GOOD_WAYS = 6
"""Orientations of the board that determine a lens well: with fewer, leaving one out changes it too much."""
OUTLIER_MEDIANS = 3.0
"""A view whose residual exceeds the median by this factor is dropped and named."""
LEAST_OUTLIER_PX = 0.4
RMS_LIMIT_PX = 0.5
"""Above this a pre-flight check warns: a flat, sharp, still board gives 0.1 to 0.3 px."""
THIRDS = (
    *("upper left", "upper middle", "upper right"),
    *("left", "middle", "right"),
    *("lower left", "lower middle", "lower right"),
)
"""Parts of the image on which coverage is judged, row by row."""
LEAST_SLANT_DEG = 15.0
"""Boards seen face on determine only the ratio of focal length and distance."""
DISTINCT_DEG = 5.0
"""Boards turned by less count as one orientation: parallel planes determine a focal length no better than one does."""
ROUNDS = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)


class Lens(Frozen):
    """Camera matrix and distortion of one camera at one focus and one image size, in files as in calculations."""

    source: str = ""
    """`lens file <hash>`, or `FITTED`."""
    size_px: tuple[int, int]
    """Width and height of the photographs that it applies to."""
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy in pixels, pixel centres on integers."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3 of OpenCV's model."""

    @property
    def camera(self) -> Floats:
        """OpenCV's camera matrix, (3, 3)."""
        fx, fy, cx, cy = self.matrix
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def check_size(self, image: Gray, where: str) -> None:
        """Raise `CaptureRefused` for an (h, w) photograph of another size: the lens does not apply to it."""
        if image.shape[::-1] != self.size_px:
            is_px, was_px = ("{} x {} px".format(*size) for size in (image.shape[::-1], self.size_px))
            raise CaptureRefused(where, f"is {is_px}, the lens was calibrated at {was_px}")

    def undistorted(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of a photograph -> where they lie in the undistorted one."""
        points, camera = pixels.reshape(-1, 1, 2).astype(np.float64), self.camera
        flat = cv2.undistortPointsIter(points, camera, np.array(self.distortion), np.eye(3), camera, ROUNDS)
        return np.asarray(flat, np.float64).reshape(-1, 2)

    def distorted(self, pixels: Floats) -> Floats:
        """(n, 2) pixels of the undistorted photograph -> where they lie in the photograph as it was taken."""
        focal, centre = np.array(self.matrix[:2]), np.array(self.matrix[2:])
        rays = np.column_stack([(pixels - centre) / focal, np.ones(len(pixels))])
        bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), self.camera, np.array(self.distortion))
        return np.asarray(bent, np.float64).reshape(-1, 2)

    def undistort(self, image: Gray) -> Gray:
        """The photograph as a lens without distortion would have taken it. Raises `CaptureRefused` for another size."""
        self.check_size(image, "the photograph")
        camera, distortion = self.camera, np.array(self.distortion)
        maps = cv2.initUndistortRectifyMap(camera, distortion, np.eye(3), camera, self.size_px, cv2.CV_16SC2)
        # Linear interpolation, that of `cv2.undistort`, blurs a sharp picture by up to half a pixel more.
        return cast("Gray", cv2.remap(image, *maps, cv2.INTER_CUBIC))


def unknown_lens(size_px: tuple[int, int]) -> Lens:
    """Lens assumed without intrinsics: no distortion, axis in the middle, focal length of one image width."""
    width, height = size_px
    focal = float(max(size_px))
    matrix = (focal, focal, (width - 1) / 2, (height - 1) / 2)
    return Lens(source=FITTED, size_px=size_px, matrix=matrix, distortion=(0.0, 0.0, 0.0, 0.0, 0.0))


def apply(homography: Floats, points: Floats) -> Floats:
    """Map (n, 2) points through a (3, 3) homography."""
    return np.asarray(cv2.perspectiveTransform(points[None], homography)[0], np.float64)


def homography(pixels: Floats, paper_mm: Floats, where: str) -> Floats:
    """Fit the (3, 3) homography from (n, 2) to (n, 2) points. Raises `CalibrationError` if they lie on a line."""
    found, _ = cv2.findHomography(pixels, paper_mm, 0)
    if found is None or not np.all(np.isfinite(found)):  # pyright: ignore[reportUnnecessaryComparison]
        raise CalibrationError(where, "the board's corners lie on a line, which does not determine a plane")
    return np.asarray(found, np.float64)


def solve(views: Sequence[BoardView], where: str) -> tuple[Lens, float, Floats, Floats]:
    """Fit a lens by `cv2.calibrateCamera` (k1, k2, p1, p2, k3).

    Returns the lens, the root mean square of all residuals and that of each view, (views,) px, and the (views, 3) unit
    normals of the boards, toward the camera. Raises `CalibrationError` if no lens fits the views.
    """
    size = views[0].size_px
    objects = [np.column_stack([view.board_mm, np.zeros(len(view.board_mm))]).astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views]
    try:
        rms, matrix, distortion, turns, _, _, _, per_view = cv2.calibrateCameraExtended(
            objects, pixels, size, np.zeros((3, 3)), np.zeros(5)
        )
    except cv2.error as error:
        raise CalibrationError(where, f"no lens explains these views: {error.err}") from None
    normals = np.stack([np.asarray(cv2.Rodrigues(turn)[0], np.float64)[:, 2] for turn in turns])
    normals = np.asarray(np.where(normals[:, 2:] < 0.0, -normals, normals), np.float64)
    fx, fy, cx, cy = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    k1, k2, p1, p2, k3 = np.ravel(distortion)[:5].tolist()
    lens = Lens(size_px=size, matrix=(fx, fy, cx, cy), distortion=(k1, k2, p1, p2, k3))
    return lens, float(rms), np.ravel(per_view).astype(np.float64), normals


class LensFile(Artefact):
    """A lens, its uncertainty, how well it explains each photograph, and where these come from."""

    lens: Lens
    ways: int
    """Number of orientations of the board."""
    rms_px: float
    """Root mean square residual over all corners of the kept views."""
    residuals_px: dict[str, float]
    """Residual of each kept view, by name."""
    dropped: dict[str, float]
    """Views left out as outliers, with their residuals."""
    unusable: dict[str, str]
    """Photographs that show no board, and the reason."""
    slants_deg: dict[str, float]
    """Angle of each kept board from face on."""
    guidance: tuple[str, ...]
    """What else to photograph; empty where the coverage is good."""
    warnings: tuple[str, ...]
    """What a pre-flight check must show."""
    schema_version: Literal[5] = 5
    software: str
    photographs: dict[str, str]
    """Name of every photograph that was given, and the sha256 of its bytes."""
    board: str
    """Description: kind, size in squares or corners, mm."""

    def lines(self) -> list[str]:
        """What the command prints: every photograph, the lens, and what to do."""
        fx, fy, cx, cy = self.lens.matrix
        return [
            *(
                f"{name}: residual {px:.3f} px, slanted by {self.slants_deg[name]:.0f} deg"
                for name, px in self.residuals_px.items()
            ),
            *(f"{name}: residual {px:.3f} px, dropped: it does not fit the rest" for name, px in self.dropped.items()),
            *(f"{name}: {why}" for name, why in self.unusable.items()),
            f"fx {fx:.2f} px, fy {fy:.2f} px, centre {cx:.1f}, {cy:.1f} px, k1 {self.lens.distortion[0]:+.4f}",
            f"residual {self.rms_px:.3f} px over {len(self.residuals_px)} views, with the board at {self.ways} angles",
            *(f"warning: {warning}" for warning in self.warnings),
            *(f"to do: {advice}" for advice in self.guidance),
        ]


def read_lens(path: Path) -> Lens:
    """Read a lens file written by `camera intrinsics`. Raises `CalibrationError`."""
    file = LensFile.read(path)
    return file.lens.model_copy(update={"source": f"lens file {file.digest}"})


def fit_lens(
    views: Sequence[BoardView], board: str, photographs: Mapping[str, str], unusable: Mapping[str, str]
) -> LensFile:
    """Fit a lens by Zhang's method to the views that fit together; `unusable` says why other photographs have no view.

    `board` describes the board, `photographs` are names and sha256 of all that were given. Raises `CalibrationError`
    for fewer than `LEAST_VIEWS` views that differ, and for photographs of several sizes.
    """
    useless = [f"{name}: {why}" for name, why in unusable.items()]
    where = f"{len(views) + len(unusable)} photographs"
    if len({view.size_px for view in views}) > 1:
        sizes = ", ".join(f"{view.name} is {view.size_px[0]} x {view.size_px[1]} px" for view in views)
        raise CalibrationError(where, f"have several sizes, so they are of two cameras or settings: {sizes}")
    kept, dropped = list(views), dict[str, float]()
    while True:
        if len(kept) < LEAST_VIEWS:
            out = f", dropped: {', '.join(sorted(dropped))}" if dropped else ""
            problem = f"{len(kept)} usable views of the board, at least {LEAST_VIEWS} needed{out}"
            raise CalibrationError(where, "; ".join([problem, *useless]))
        lens, rms_px, residuals, normals = solve(kept, where)
        worst = int(np.argmax(residuals))
        # The median of the others: one bad view of four would raise the median of all and be kept.
        others = float(np.median(np.delete(residuals, worst)))
        if residuals[worst] <= max(LEAST_OUTLIER_PX, OUTLIER_MEDIANS * others):
            break
        dropped[kept[worst].name] = float(residuals[worst])
        del kept[worst]
    ways = held(normals)
    fewest = min(int(ways.max()), int(held(nominal_normals(kept)).max())) + 1
    if fewest < LEAST_VIEWS:
        problem = (
            f"{len(kept)} usable views; different angles of the board: {fewest}, at least {LEAST_VIEWS} are needed"
        )
        raise CalibrationError(where, "; ".join([f"{problem}: slant the board to other sides", *useless]))
    slants = {v.name: float(s) for v, s in zip(kept, np.degrees(np.arccos(normals[:, 2])), strict=True)}
    warnings = [f"{view.name}: {flag}" for view in kept for flag in view.flags]
    if rms_px > RMS_LIMIT_PX:
        exceeds = f"residual {rms_px:.2f} px exceeds {RMS_LIMIT_PX:g} px"
        warnings.insert(0, f"{exceeds}: is the board flat, sharp and still, and was only one camera used?")
    return LensFile(
        lens=lens,
        ways=int(ways.max()) + 1,
        rms_px=rms_px,
        residuals_px={view.name: float(r) for view, r in zip(kept, residuals, strict=True)},
        dropped=dropped,
        unusable=dict(unusable),
        slants_deg=slants,
        guidance=guidance(kept, list(slants.values()), int(ways.max()) + 1),
        warnings=tuple(warnings),
        software=made_by(),
        photographs=dict(photographs),
        board=board,
    )


def guidance(views: Sequence[BoardView], slants_deg: Sequence[float], ways: int = GOOD_WAYS) -> tuple[str, ...]:
    """Instructions for further photographs: what these views, in `ways` orientations of the board, do not cover."""
    wanted: list[str] = []
    if len(views) < GOOD_VIEWS:
        wanted.append(f"take more photographs ({len(views)} of {GOOD_VIEWS} so far)")
    width, height = views[0].size_px
    places = np.concatenate([view.pixels for view in views])
    counts, _, _ = np.histogram2d(places[:, 1], places[:, 0], bins=3, range=((0, height), (0, width)))
    empty = [name for name, count in zip(THIRDS, counts.ravel(), strict=True) if not count]
    if ways < GOOD_WAYS:
        wanted.append(f"hold the board at more different angles ({ways} of {GOOD_WAYS} so far)")
    if empty:
        wanted.append(f"bring the board into the {', '.join(empty)} of the image: no corner was seen there")
    slanted = sum(slant >= LEAST_SLANT_DEG for slant in slants_deg)
    if slanted < LEAST_VIEWS:
        how = f"slant the board by {LEAST_SLANT_DEG:.0f} to 45 deg in at least {LEAST_VIEWS} photographs"
        wanted.append(f"{how} ({slanted} so far)")
    return tuple(wanted)


def held(normals: Floats) -> NDArray[np.int64]:
    """(n,) index of each board's orientation, from the (n, 3) unit normals of the boards."""
    first, ways = list[Floats](), list[int]()
    for normal in normals:
        alike = (k for k, other in enumerate(first) if float(normal @ other) > np.cos(np.radians(DISTINCT_DEG)))
        ways.append(next(alike, len(first)))
        if ways[-1] == len(first):
            first.append(normal)
    return np.array(ways, np.int64)


def nominal_normals(views: Sequence[BoardView]) -> Floats:
    """(n, 3) unit normals of the boards, for an undistorted lens whose focal length is one image width.

    They are rough, but a lens that was wrongly fitted to boards of one orientation cannot make them differ.
    """
    rays = np.linalg.inv(unknown_lens(views[0].size_px).camera)
    normals = list[Floats]()
    for view in views:
        across, along, _ = (rays @ homography(view.board_mm, view.pixels, view.name)).T
        normal = np.cross(across, along)
        normals.append(normal / (np.linalg.norm(normal) * (-1.0 if normal[2] < 0.0 else 1.0)))
    return np.array(normals)
