"""Measurements of a camera, as immutable files named after the hash of their contents."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from brushloop.calibrate.artefact import Artefact, load_artefact
from brushloop.calibrate.board.intrinsics import Fitted
from brushloop.calibrate.board.lens import Lens, LensUsed, lens_of
from brushloop.calibrate.board.register import Registration


class LensFile(Artefact):
    """Intrinsics with everything that is needed to judge them."""

    kind: Literal["lens"] = "lens"
    schema_version: Literal[2] = 2
    software: str
    photographs: dict[str, str]
    """Name of every photograph that was given, and the sha256 of its bytes."""
    board: str
    """Description: kind, size in squares or corners, mm."""
    size_px: tuple[int, int]
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy in pixels, pixel centres on integers."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3 of OpenCV's model."""
    focal_se_px: tuple[float, float] | None
    """Standard errors of fx and fy, by leaving out each orientation of the board; None with too few orientations."""
    rms_px: float
    rms_limit_px: float
    residuals_px: dict[str, float]
    dropped: dict[str, float]
    """Outlier views and their residuals."""
    unusable: dict[str, str]
    """Photographs without a usable board or with nothing new, and the reason."""
    guidance: tuple[str, ...]
    warnings: tuple[str, ...]

    def lens(self) -> Lens:
        """The lens to compute with."""
        return lens_of(self.matrix, self.distortion, self.size_px)


def lens_file(
    fitted: Fitted,
    board: str,
    photographs: dict[str, str],
    rms_limit_px: float,
    software: str,
) -> LensFile:
    """The artefact of a fitted lens."""
    used = LensUsed.of(fitted.lens, "")
    return LensFile(
        software=software,
        photographs=photographs,
        board=board,
        size_px=used.size_px,
        matrix=used.matrix,
        distortion=used.distortion,
        focal_se_px=fitted.focal_se_px,
        rms_px=fitted.rms_px,
        rms_limit_px=rms_limit_px,
        residuals_px=fitted.residuals_px,
        dropped=fitted.dropped,
        unusable=fitted.unusable,
        guidance=fitted.guidance,
        warnings=fitted.warnings,
    )


def read_lens(path: Path) -> LensUsed:
    """Read a lens file written by `camera intrinsics`. Raises `CalibrationError`."""
    file = load_artefact(path, LensFile)
    source = f"lens file {file.digest}"
    return LensUsed(source=source, size_px=file.size_px, matrix=file.matrix, distortion=file.distortion)


class RegistrationFile(Artefact):
    """Where the robot's points lie on the paper, with the residual of each."""

    kind: Literal["registration"] = "registration"
    schema_version: Literal[3] = 3
    software: str
    source: str
    """The table of points, or the session, and its sha256."""
    robot_to_paper: tuple[float, float, float, float, float, float]
    """(2, 3) row by row: mm in the robot's base frame to mm in the paper frame."""
    board_origin_mm: tuple[float, float]
    """Lower left corner of the board in the paper frame, as it was assumed."""
    origin_mm: tuple[float, float]
    yaw_deg: float
    """Origin and yaw of the paper frame in the base frame, as in `[paper]` of rig.toml."""
    rms_mm: float
    left_out_rms_mm: float
    """Root mean square error of points that are each predicted by the others."""
    residuals_mm: dict[str, tuple[float, float]]
    dropped: dict[str, tuple[float, float]]


def registration_file(
    fitted: Registration, board_origin_mm: tuple[float, float], source: str, software: str
) -> RegistrationFile:
    """The artefact of a registration."""
    a, b, x, c, d, y = (float(v) for v in fitted.matrix.ravel())
    residuals = {n: (float(r[0]), float(r[1])) for n, r in zip(fitted.names, fitted.residuals_mm, strict=True)}
    return RegistrationFile(
        software=software,
        source=source,
        robot_to_paper=(a, b, x, c, d, y),
        board_origin_mm=board_origin_mm,
        origin_mm=fitted.origin_mm,
        yaw_deg=fitted.yaw_deg,
        rms_mm=fitted.rms_mm,
        left_out_rms_mm=fitted.left_out_rms_mm,
        residuals_mm={n: r for n, r in residuals.items() if n not in fitted.dropped},
        dropped={n: residuals[n] for n in fitted.dropped},
    )
