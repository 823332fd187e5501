"""The calibration of a session: an immutable file that says where the paper lies in its photographs."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Artefact
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.pix2len import apply
from brushloop.calibrate.board.spec import BoardSpec

FITTED = "k1 fitted on the board"
"""Source of a lens where no lens file was given and none was needed."""


class Calibration(Artefact):
    """Scale and paper plane, the recording they come from and the software. Equal inputs give an equal file."""

    schema_version: Literal[3] = 3
    session_id: str
    source: str
    """`loopback rig` or `real capture`, as the recording says."""
    recording_sha256: str
    software: str
    image_to_paper: tuple[float, float, float, float, float, float, float, float, float]
    """Homography, row by row: pixels (centres on integers) of the undistorted photograph to mm in the paper frame."""
    mm_per_px: float
    """pix2len in the middle of the corners that were seen."""
    mm_per_px_low: float
    mm_per_px_high: float
    """95 % interval."""
    rms_px: float
    corners: int
    corners_dropped: int
    """Outliers: seen, but not on the plane of the others."""
    preprocess: dict[str, float]
    lens: Lens
    """Lens by which photographs are undistorted first."""
    middle_px: tuple[float, float]
    """Pixel at which `mm_per_px` holds, in the photograph as it was taken."""
    board: BoardSpec
    still_sha256: str
    """sha256 of the encoded photograph of the board that this was measured on."""
    flags: tuple[str, ...] = ()
    """What was wrong with that photograph: partly hidden, saturated."""

    def homography(self) -> NDArray[np.float64]:
        """`image_to_paper` as (3, 3)."""
        return np.array(self.image_to_paper).reshape(3, 3)

    def to_image(self, paper_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) mm in the paper frame -> pixels of the photograph as it was taken."""
        undistorted = apply(np.asarray(np.linalg.inv(self.homography()), np.float64), paper_mm)
        return self.lens.distorted(undistorted)

    def to_paper(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) pixels of the photograph as it was taken -> mm in the paper frame."""
        return apply(self.homography(), self.lens.undistorted(pixels))
