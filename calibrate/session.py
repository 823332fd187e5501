"""A session opened for calculations; how it is calibrated, and which calibration it uses."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from brushloop.calibrate.artefact import current, load_artefact, made_by, put_to_use
from brushloop.calibrate.board.detect import find_board
from brushloop.calibrate.board.lens import Lens, rms
from brushloop.calibrate.board.view import (
    NO_BOARD,
    board_of,
    board_stills,
    calibration_plane,
    known_lens,
    paper_mm,
    rig_of,
)
from brushloop.calibrate.calibration import Calibration, Foreign
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.store import FOLDER as FINISHED
from brushloop.calibrate.store import Store
from brushloop.calibrate.stroke.params import Params
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Stroke
from brushloop.sessions.terminal import Progress, unseen

FITTED = "k1 fitted on the board"
STEPS = "steps done: read the session, fit the plane, check the file"


Kind = Literal["press", "drag"]
OTHER_KIND = {
    "press": "holds drags, which `fit --drags` and `validate` take: this needs presses",
    "drag": "holds presses, which `fit` takes without --drags: this needs drags",
}


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A recording with what its strokes are read with."""

    recording: Recording
    sha256: str
    strokes: tuple[Stroke, ...]
    """At least one."""
    calibration: Calibration | None
    """None for an import, which has its own scale."""
    store: Store

    @property
    def header(self) -> Header:
        """Where the strokes come from."""
        return self.recording.header

    @property
    def calibration_digest(self) -> str:
        """Digest of the calibration; empty for an import."""
        return "" if self.calibration is None else self.calibration.digest


def open_session(path: Path, calibration: Path | None = None, kind: Kind | None = None) -> OpenSession:
    """Open a session by its folder or MCAP file, with the calibration given, else the one in use.

    Raises `InputError`, and `CalibrationError` for a session without strokes or with some of another kind, and as
    `calibration_of` does.
    """
    recording = Recording(path)
    sha256, strokes = recording.sha256, tuple(recording.stroke_records())
    if not strokes:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if kind is not None and any(stroke.kind != kind for stroke in strokes):
        raise CalibrationError(str(recording.path), OTHER_KIND[kind])
    used = calibration_of(recording, strokes[0], sha256, calibration)
    return OpenSession(recording, sha256, strokes, used, Store(recording.path.parent / FINISHED))


def calibrate_session(session: Path, lens: Path | None = None, progress: Progress = unseen) -> Path:
    """Calibrate a session, save the result beside the recording and use it from now on; returns its path.

    Without a lens file, the lens that the session was collected with is used. Raises `CalibrationError`, also for an
    unknown lens that visibly distorts.
    """
    recording = Recording(session)
    if recording.header.source.imported:
        raise CalibrationError(str(recording.path), "is an import and has its own scale: continue with `validate`")
    where = str(recording.path)
    spec, known = board_of(recording), known_lens(recording, lens)
    progress(STEPS, 0, 3)
    stills = [still for _, still in recording.stills_of("board")]
    progress(STEPS, 1, 3)
    if not stills:
        raise CalibrationError(where, NO_BOARD)
    image, given = decode_gray(stills[-1], where), known
    plane = calibration_plane(image, spec, given, where, rig_of(recording).sheet_mm)
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
    progress(STEPS, 3, 3)
    return put_to_use(calibration, recording.path.parent)


def apply_calibration(path: Path, session: Path, *, force: bool = False) -> Path:
    """Use a calibration for a session from now on; returns its path.

    A calibration of another recording is refused without `force`; with it, a new artefact names the origin and the
    error of this session's board under it. Raises `CalibrationError`.
    """
    recording, given = Recording(session), load_artefact(path, Calibration)
    folder = recording.path.parent
    if recording.header.source.imported:
        raise CalibrationError(str(recording.path), "is an import and has its own scale: no calibration can be applied")
    if given.recording_sha256 == recording.sha256:
        return put_to_use(given, folder)
    if force:
        return put_to_use(_labelled(given, recording), folder)
    problem = f"belongs to another recording ({given.session_id}); --force applies it, and labels every result"
    raise CalibrationError(str(path), problem)


def calibration_of(recording: Recording, first: Stroke, digest: str, given: Path | None) -> Calibration | None:
    """The artefact given, or the one that the session uses; None for an import, which brings its own scale.

    Raises `CalibrationError` where there is none, or it belongs to another recording.
    """
    if first.px_per_mm is not None:
        return None
    path = given or current(recording.path.parent)
    if path is None:
        raise CalibrationError(
            str(recording.path), f"is not calibrated: run `brushloop calibrate {recording.path.parent}`"
        )
    calibration = load_artefact(path, Calibration)
    if calibration.recording_sha256 != digest:
        problem = (
            f"belongs to another recording ({calibration.session_id}): `brushloop calibrate apply --force` labels it"
        )
        raise CalibrationError(str(path), problem)
    return calibration


def lens_in_use(folder: Path) -> Lens | None:
    """The lens of the calibration that a session uses, else the one that it was collected with.

    Raises `CalibrationError`.
    """
    path = current(folder)
    lens = None if path is None else load_artefact(path, Calibration).lens
    return lens if lens is not None else rig_of(folder).lens


def _labelled(given: Calibration, recording: Recording) -> Calibration:
    origin = given.foreign or Foreign(
        digest=given.digest,
        session_id=given.session_id,
        source=given.source,
        recording_sha256=given.recording_sha256,
        board_off_mm=None,
    )
    return given.model_copy(
        update={
            "schema_version": type(given).model_fields["schema_version"].default,
            "session_id": recording.header.session_id,
            "source": recording.header.source,
            "recording_sha256": recording.sha256,
            "foreign": origin.model_copy(update={"board_off_mm": _board_off_mm(given, recording)}),
        }
    )


def _board_off_mm(given: Calibration, recording: Recording) -> float | None:
    """Root mean square error of this session's last board under the calibration; None if none is seen."""
    spec, where = board_of(recording), str(recording.path)
    off_mm: float | None = None
    for _, image in board_stills(recording):
        given.lens.check_size(image, where)
        try:
            view = find_board(image, spec, where)
        except CalibrationError:
            continue
        off_mm = rms(given.to_paper(view.pixels) - paper_mm(view, spec))
    return off_mm
