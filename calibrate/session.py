"""A session opened for calculations; how it is calibrated, and which calibration it uses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from brushloop.calibrate.artefact import current, load_artefact
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.view import rig_of
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.store import FOLDER as FINISHED
from brushloop.calibrate.store import Store
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Stroke

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


def open_session(path: Path, kind: Kind | None = None) -> OpenSession:
    """Open a session by its folder or MCAP file, with the calibration in use.

    Raises `InputError`, and `CalibrationError` for a session without strokes or with some of another kind, and as
    `calibration_of` does.
    """
    recording = Recording(path)
    sha256, strokes = recording.sha256, tuple(recording.stroke_records())
    if not strokes:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if kind is not None and any(stroke.kind != kind for stroke in strokes):
        raise CalibrationError(str(recording.path), OTHER_KIND[kind])
    used = calibration_of(recording, strokes[0])
    return OpenSession(recording, sha256, strokes, used, Store(recording.path.parent / FINISHED))


def calibration_of(recording: Recording, first: Stroke) -> Calibration | None:
    """The calibration that a session uses; None for an import, which brings its own scale.

    Raises `CalibrationError` where there is none, or it belongs to another recording.
    """
    if first.px_per_mm is not None:
        return None
    path = current(recording.path.parent)
    if path is None:
        raise CalibrationError(
            str(recording.path), f"is not calibrated: run `brushloop calibrate {recording.path.parent}`"
        )
    calibration = load_artefact(path, Calibration)
    if calibration.recording_sha256 != recording.sha256:
        problem = f"belongs to another recording ({calibration.session_id}): `brushloop calibrate` makes its own"
        raise CalibrationError(str(path), problem)
    return calibration


def lens_in_use(folder: Path) -> Lens | None:
    """The lens of the calibration that a session uses, else the one that it was collected with.

    Raises `CalibrationError`.
    """
    path = current(folder)
    lens = None if path is None else load_artefact(path, Calibration).lens
    return lens if lens is not None else rig_of(folder).lens
