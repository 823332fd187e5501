"""`brushloop calibrate SESSION` as a function: the calibration of a session and its page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.pages.camera import write_calibration_page
from brushloop.calibrate.report import framed
from brushloop.calibrate.session import calibrate_session as calibrate
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen


@dataclass(frozen=True, slots=True)
class CalibrateRequest:
    """What is calibrated."""

    session: Path
    lens: Path | None = None
    """Lens file; None is the session's own."""


@dataclass(frozen=True, slots=True)
class Calibrated:
    """The calibration that a session uses from now on."""

    calibration: Calibration
    path: Path
    page: Path

    def lines(self) -> list[str]:
        """What the command prints."""
        found = self.calibration
        return [
            *(f"warning: {flag}" for flag in found.flags),
            f"pix2len {found.mm_per_px:.5f} mm/px (95 %: {found.mm_per_px_low:.5f} to {found.mm_per_px_high:.5f}), "
            f"board residual {found.rms_px:.3f} px over {found.corners} corners, {found.source}",
            f"lens: {found.lens.source if found.lens else 'none'}",
            str(self.path),
            f"Page: {self.page}",
        ]

    def _repr_html_(self) -> str:
        return framed(self.page)


def calibrate_session(request: CalibrateRequest, progress: Progress = unseen) -> Calibrated:
    """Calibrate a session and write the page. Raises what `calibrate.session.calibrate_session` raises."""
    path = calibrate(request.session, request.lens, progress)
    page = write_calibration_page(Recording(request.session), path)
    return Calibrated(load_artefact(path, Calibration), path, page)
