"""`brushloop calibrate SESSION` as a function: the calibration of a session and its page; and another one applied."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact, made_by, put_to_use
from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import rms
from brushloop.calibrate.board.view import (
    NO_BOARD,
    board_of,
    board_stills,
    calibration_plane,
    known_lens,
    paper_mm,
    rig_of,
)
from brushloop.calibrate.calibration import FITTED, Calibration, Foreign
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.pages.camera import write_calibration_page
from brushloop.calibrate.report import framed
from brushloop.calibrate.stroke.params import Params
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen

STEPS = "steps done: read the session, fit the plane, check the file"


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
        calibration = self.calibration
        low, high = calibration.mm_per_px_low, calibration.mm_per_px_high
        return [
            *(f"warning: {flag}" for flag in calibration.flags),
            f"pix2len {calibration.mm_per_px:.5f} mm/px (95 %: {low:.5f} to {high:.5f}), "
            f"board residual {calibration.rms_px:.3f} px over {calibration.corners} corners, {calibration.source}",
            f"lens: {calibration.lens.source if calibration.lens else 'none'}",
            str(self.path),
            f"Page: {self.page}",
        ]

    def _repr_html_(self) -> str:
        return framed(self.page)


def calibrate_session(request: CalibrateRequest, progress: Progress = unseen) -> Calibrated:
    """Calibrate a session, use the result from now on, and write its page.

    Raises `CalibrationError`, also for an unknown lens that visibly distorts.
    """
    recording = Recording(request.session)
    if recording.header.source.imported:
        raise CalibrationError(str(recording.path), "is an import and has its own scale: continue with `validate`")
    where = str(recording.path)
    spec, known = board_of(recording), known_lens(recording, request.lens)
    progress(STEPS, 0, 3)
    stills = [still for _, still in recording.stills_of("board")]
    progress(STEPS, 1, 3)
    if not stills:
        raise CalibrationError(where, NO_BOARD)
    plane = calibration_plane(decode_gray(stills[-1], where), spec, known, where, rig_of(recording).sheet_mm)
    progress(STEPS, 2, 3)
    low, high = plane.interval_mm_per_px
    calibration = Calibration(
        session_id=recording.header.session_id,
        source=recording.header.source,
        recording_sha256=recording.sha256,
        software=made_by(),
        image_to_paper=tuple(plane.image_to_paper.ravel().tolist()),  # pyright: ignore[reportArgumentType]
        mm_per_px=plane.mm_per_px,
        mm_per_px_low=low,
        mm_per_px_high=high,
        rms_px=plane.rms_px,
        corners=plane.corners,
        corners_dropped=len(plane.dropped),
        preprocess=dataclasses.asdict(Params()),
        lens=plane.lens if known else plane.lens.model_copy(update={"source": FITTED}),
        middle_px=plane.middle_px,
        board=spec,
        flags=plane.flags,
        still_sha256=hashlib.sha256(stills[-1]).hexdigest(),
    )
    path = put_to_use(calibration, recording.path.parent)
    progress(STEPS, 3, 3)
    return Calibrated(calibration, path, write_calibration_page(recording, path))


def apply_calibration(path: Path, session: Path, *, force: bool = False) -> Path:
    """Use a calibration for a session from now on; returns its path.

    A calibration of another recording is refused without `force`; with it, a new artefact names the origin and the
    error of this session's board under it. Raises `CalibrationError`.
    """
    recording, other = Recording(session), load_artefact(path, Calibration)
    folder = recording.path.parent
    if recording.header.source.imported:
        raise CalibrationError(str(recording.path), "is an import and has its own scale: no calibration can be applied")
    if other.recording_sha256 == recording.sha256:
        return put_to_use(other, folder)
    if force:
        return put_to_use(_labelled(other, recording), folder)
    problem = f"belongs to another recording ({other.session_id}); --force applies it, and labels every result"
    raise CalibrationError(str(path), problem)


def _labelled(other: Calibration, recording: Recording) -> Calibration:
    origin = other.foreign or Foreign(
        digest=other.digest,
        session_id=other.session_id,
        source=other.source,
        recording_sha256=other.recording_sha256,
        board_off_mm=None,
    )
    return other.model_copy(
        update={
            "schema_version": type(other).model_fields["schema_version"].default,
            "session_id": recording.header.session_id,
            "source": recording.header.source,
            "recording_sha256": recording.sha256,
            "foreign": origin.model_copy(update={"board_off_mm": _board_off_mm(other, recording)}),
        }
    )


def _board_off_mm(other: Calibration, recording: Recording) -> float | None:
    """Root mean square error of this session's last board under the calibration; None if none is seen."""
    spec, where = board_of(recording), str(recording.path)
    off_mm: float | None = None
    for _, image in board_stills(recording):
        other.lens.check_size(image, where)
        try:
            view = find_board(image, spec, where)
        except CalibrationError:
            continue
        off_mm = rms(other.to_paper(view.pixels) - paper_mm(view, spec))
    return off_mm
