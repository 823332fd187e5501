"""A session opened for calculations: its rig, the calibration in use, and its store of finished work."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import AliasPath, BaseModel, Field

from brushloop.calibrate import work
from brushloop.calibrate.artefact import Artefact, checked_fields, current, made_by
from brushloop.calibrate.board.lens import Lens
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.board.spec import BoardSpec
from brushloop.calibrate.errors import CalibrationError
from brushloop.sessions.disk import read_bounded
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Header, Stroke

EFFECTIVE = "rig.effective.json"
"""The configuration in effect: rig.toml, with the changes that the environment made."""
OTHER_KIND = {
    "press": "holds drags, but presses are needed here (`fit` and `validate` also take drags)",
    "drag": "holds presses, but drags are needed here",
}


class Calibration(Plane, Artefact):
    """The paper plane in a session's photographs, the recording it comes from and the software. Never changed.

    Equal inputs give an equal file.
    """

    schema_version: Literal[4] = 4
    session_id: str
    source: str
    """`loopback rig` or `real capture`, as the recording says."""
    recording_sha256: str
    software: str
    board: BoardSpec
    still_sha256: str
    """sha256 of the encoded photograph of the board that this was measured on."""


@dataclass(frozen=True, slots=True)
class OpenSession:
    """A recording with what its strokes are read with."""

    recording: Recording
    sha256: str
    strokes: tuple[Stroke, ...]
    """At least one."""
    calibration: Calibration | None
    """None for an import, which has its own scale."""
    store: work.Store

    @property
    def header(self) -> Header:
        """Where the strokes come from."""
        return self.recording.header

    @property
    def calibration_digest(self) -> str:
        """Digest of the calibration; empty for an import."""
        return "" if self.calibration is None else self.calibration.digest

    @property
    def provenance(self) -> dict[str, Any]:
        """The fields of a `SessionFit` that say what it was fitted to, and by which software."""
        header = self.header
        origin = {"session_id": header.session_id, "source": str(header.source), "recording_sha256": self.sha256}
        return origin | {"calibration": self.calibration_digest, "software": made_by()}


def open_session(place: Path | Recording, kind: Literal["press", "drag"] | None = None) -> OpenSession:
    """Open a session by its folder, MCAP file or opened recording, with the calibration in use.

    Raises `InputError`, and `CalibrationError` for a session without strokes, with some of another kind, without a
    calibration, or with that of another recording.
    """
    recording = place if isinstance(place, Recording) else Recording(place)
    sha256, strokes = recording.sha256, tuple(recording.stroke_records())
    if not strokes:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if kind is not None and any(stroke.kind != kind for stroke in strokes):
        raise CalibrationError(str(recording.path), OTHER_KIND[kind])
    folder, calibration = recording.path.parent, None
    if strokes[0].px_per_mm is None:
        used = current(folder)
        if used is None:
            raise CalibrationError(str(recording.path), f"is not calibrated: run `brushloop calibrate {folder}`")
        calibration = Calibration.read(used)
        if calibration.recording_sha256 != sha256:
            problem = f"belongs to another recording ({calibration.session_id}): run `brushloop calibrate` again"
            raise CalibrationError(str(used), problem)
    return OpenSession(recording, sha256, strokes, calibration, work.Store(folder / work.FOLDER))


class RigView(BaseModel):
    """What a session recorded of the rig."""

    board: BoardSpec
    sheet_mm: tuple[float, float] | None = Field(default=None, validation_alias=AliasPath("paper", "size_mm"))
    """Width and height of the sheet that lies on the board; None if not recorded."""
    lens: Lens | None = Field(default=None, validation_alias=AliasPath("camera", "optics"))
    """The lens that the session was collected with, if any."""


def rig_of(session: Recording | Path) -> RigView:
    """The rig of a recording, or of the folder of a session that may still be open. Raises `CalibrationError`."""
    inside = isinstance(session, Recording)
    where = f"{session.path} {EFFECTIVE}" if inside else str(session / EFFECTIVE)
    data = session.attachment(EFFECTIVE) if inside else read_bounded(session / EFFECTIVE)
    with checked_fields(where):
        return RigView.model_validate_json(data)
