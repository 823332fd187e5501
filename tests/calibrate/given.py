"""What several tests are given: a camera straight above the paper, and how a plan was made."""

from __future__ import annotations

from brushloop.calibrate.board.lens import LensUsed, unknown_lens
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.writing.plan_record import PlannedBy

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
    lens=LensUsed.of(unknown_lens((1000, 800)), "test"),
    middle_px=(0.0, 0.0),
    board=BoardSpec(squares=(5, 7), square_mm=40.0, marker_mm=20.0, origin_mm=(0.0, 0.0)),
    still_sha256="",
)
BY = PlannedBy(
    model="ccd-bsm",
    radius_mm=6.0,
    length_mm=48.0,
    lam=None,
    depth_range_mm=(0.5, 20.0),
    tilt_range_deg=(0.0, 10.0),
    turn_deg_mm=12.0,
    speed_mm_s=15.0,
)
