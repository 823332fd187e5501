"""What several tests are given: a camera straight above the paper, a lens file, and how a plan was made."""

from __future__ import annotations

import math
from pathlib import Path

from brushloop.calibrate.board.lens import Lens, LensFile, unknown_lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.session import Calibration


def flat_plane(size_px: tuple[int, int], mm_per_px: tuple[float, float]) -> Plane:
    """The plane seen straight from above by a camera of this (width, height); the origin is the lower left corner."""
    x_mm, y_mm = mm_per_px
    scale = math.sqrt(x_mm * y_mm)
    return Plane(
        # Pixel centres on integers: pixel (0, 0) is the middle of the first square.
        image_to_paper=(x_mm, 0.0, 0.5 * x_mm, 0.0, -y_mm, (size_px[1] - 0.5) * y_mm, 0.0, 0.0, 1.0),
        mm_per_px=scale,
        mm_per_px_low=scale,
        mm_per_px_high=scale,
        rms_px=0.0,
        corners=24,
        corners_dropped=0,
        lens=unknown_lens(size_px),
        middle_px=(0.0, 0.0),
    )


CALIBRATION = Calibration(
    **flat_plane((1000, 800), (0.1, 0.1)).model_dump(),
    session_id="test",
    source="loopback rig",
    recording_sha256="",
    software="",
    board=BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, origin_mm=(0.0, 0.0)),
    still_sha256="",
)


def kept_lens(
    folder: Path,
    size_px: tuple[int, int],
    k1: float,
    focal_px: float = 1024.0,
    centre_off_px: tuple[float, float] = (0, 0),
) -> Path:
    """A lens file as `camera intrinsics` would write it."""
    centre = ((side - 1) / 2 + off for side, off in zip(size_px, centre_off_px, strict=True))
    lens = Lens(size_px=size_px, matrix=(focal_px, focal_px, *centre), distortion=(k1, 0.0, 0.0, 0.0, 0.0))
    return LensFile(
        software="brushloop test",
        photographs={"0.png": "ab" * 32},
        board="a board",
        lens=lens,
        focal_se_px=(1.0, 1.0),
        ways=6,
        rms_px=0.2,
        residuals_px={"0.png": 0.2},
        dropped={},
        unusable={},
        slants_deg={"0.png": 20.0},
        guidance=(),
        warnings=(),
    ).save(folder)
