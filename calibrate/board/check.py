"""Pre-flight: may this camera be measured with? Warnings in words, before a session begins."""

from __future__ import annotations

from calibrate.board.artefact import LensFile
from calibrate.board.intrinsics import RMS_LIMIT_PX
from calibrate.board.lens import Gray
from calibrate.board.plane import Plane
from calibrate.board.scale import BoardSpec
from calibrate.board.view import bend, see_flagged

LEAST_PX_PER_MM = 4.0
"""Below this a tip of 0.5 mm is two pixels wide."""
WORST_INTERVAL = 5e-4
"""Relative half width of pix2len's interval: 0.01 mm over 20 mm."""
REFOCUSED = 0.02
"""Difference of k1 from the calibrated one beyond which the lens is not as it was."""


def preflight(
    image: Gray, spec: BoardSpec, lens: LensFile | None = None, rms_limit_px: float = RMS_LIMIT_PX
) -> tuple[Plane, tuple[str, ...]]:
    """The plane in a photograph of the board, and what an operator should know before going on.

    Raises `CalibrationError` where the board is not seen at all.
    """
    plane, flags = see_flagged(image, spec, lens.lens() if lens else None)
    told = list(flags)
    if lens is not None and lens.rms_px > rms_limit_px:
        told.append(f"the lens was calibrated with a residual of {lens.rms_px:.2f} px, limit {rms_limit_px:g} px")
    if (bent := bend(plane, known=lens is not None)) != "":
        told.append(bent)
    if plane.rms_px > rms_limit_px:
        told.append(f"the board's residual is {plane.rms_px:.2f} px, limit {rms_limit_px:g} px: is the board flat?")
    if lens is not None and abs(float(plane.lens.distortion[0]) - lens.distortion[0]) > REFOCUSED:
        told.append(
            f"k1 is {float(plane.lens.distortion[0]):+.3f} here and was {lens.distortion[0]:+.3f}: "
            "was the lens refocused?"
        )
    if 1.0 / plane.mm_per_px < LEAST_PX_PER_MM:
        told.append(f"{1.0 / plane.mm_per_px:.1f} px/mm are few, at least {LEAST_PX_PER_MM:g} are wanted")
    low, high = plane.interval_mm_per_px
    if (high - low) / 2.0 > WORST_INTERVAL * plane.mm_per_px:
        told.append(f"pix2len is only known to {50.0 * (high - low) / plane.mm_per_px:.2f} %: show more of the board")
    if plane.dropped:
        told.append(f"{len(plane.dropped)} corners do not lie on the plane of the others")
    return plane, tuple(told)
