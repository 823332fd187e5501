"""The calibration of a session: an immutable file that says where the paper lies in its photographs."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import Artefact, Frozen
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.pix2len import apply
from brushloop.calibrate.board.spec import BoardSpec

FITTED = "k1 fitted on the board"
"""Source of a lens where no lens file was given and none was needed."""


class Foreign(Frozen):
    """Origin of a calibration that was made for another session and applied by force, and its error here."""

    digest: str
    """Digest of the applied artefact."""
    session_id: str
    source: str
    recording_sha256: str
    board_off_mm: float | None
    """Root mean square error of this session's own board under it; None if no board is seen."""


class Calibration(Artefact):
    """Scale and paper plane, the recording they come from and the software. Equal inputs give an equal file."""

    schema_version: Literal[2] = 2
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
    foreign: Foreign | None = None

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

    @property
    def named(self) -> str:
        """Name for reports: the digest, and the label if there is one."""
        return f"{self.digest}, {self.label}" if self.label else self.digest

    @property
    def label(self) -> str:
        """Note that every result must carry; empty for a session's own calibration."""
        if self.foreign is None:
            return ""
        off = (
            "" if self.foreign.board_off_mm is None else f", its board lies {self.foreign.board_off_mm:.2f} mm off here"
        )
        return f"foreign calibration: {self.foreign.digest} of {self.foreign.session_id} ({self.foreign.source}){off}"
