"""What several tests are given: a camera straight above the paper, a lens file, and how a plan was made."""

from __future__ import annotations

from pathlib import Path

from brushloop.calibrate.board.intrinsics import LensFile
from brushloop.calibrate.board.lens import Lens, unknown_lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.calibration import Calibration

CALIBRATION = Calibration(
    session_id="test",
    source="loopback rig",
    recording_sha256="",
    software="",
    # Pixel centres on integers: pixel (0, 0) is the middle of the first 0.1 mm.
    image_to_paper=(0.1, 0.0, 0.05, 0.0, -0.1, 79.95, 0.0, 0.0, 1.0),
    mm_per_px=0.1,
    mm_per_px_low=0.1,
    mm_per_px_high=0.1,
    rms_px=0.0,
    corners=24,
    corners_dropped=0,
    preprocess={},
    lens=unknown_lens((1000, 800)),
    middle_px=(0.0, 0.0),
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
