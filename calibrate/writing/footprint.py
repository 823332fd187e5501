"""The dragged footprint of a brush, fitted to written figures, as a file that plans are made with."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import SessionFit, load_artefact, put_to_use
from brushloop.calibrate.compare.similarity import binary_scores
from brushloop.calibrate.drags.captures import read_drags
from brushloop.calibrate.errors import CalibrationError
from brushloop.model.footprint import NAMES, Footprint, fit_footprint
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "footprint"
MM_PER_PX = 0.5
LEAST = 3
"""Least number of strokes: fewer do not distinguish the discs."""


class FootprintArtefact(SessionFit):
    """A fitted footprint on disk. Equal inputs give an equal file."""

    values: dict[str, Annotated[float, Field(allow_inf_nan=False)]]
    images: int
    strokes: int
    csim_percent: float
    """Mean agreement with the ink that it was fitted to, ink = 1: an upper bound of what it predicts."""

    def footprint(self) -> Footprint:
        """The fitted footprint."""
        return Footprint(tuple(self.values[name] for name in NAMES))

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.values) != set(NAMES):
            raise ValueError(
                f"values: expected the {len(NAMES)} of this version; fit the session again with `brushloop write fit`"
            )
        return self


def fit_session(session: Path, progress: Progress = unseen) -> tuple[FootprintArtefact, Path]:
    """Fit the figures of a session and put the result to use; returns it with its path.

    Raises `CalibrationError` if the session holds too few strokes that travel.
    """
    drawn = read_drags(session, MM_PER_PX, progress=progress)
    if drawn.calibration is None:
        raise CalibrationError(str(session), "is an import: a footprint is fitted to figures that the arm wrote")
    if len(drawn.paths) < LEAST:
        raise CalibrationError(str(session), f"holds {len(drawn.paths)} strokes, at least {LEAST} are needed")
    found = fit_footprint(drawn.paths, drawn.groups, drawn.ink, drawn.x_mm, drawn.y_mm)
    groups = zip(drawn.groups, drawn.groups[1:], strict=False)
    predicted = np.array([found.distance(drawn.paths[a:b], drawn.x_mm, drawn.y_mm) > 0.0 for a, b in groups])
    agreement = binary_scores(predicted, drawn.ink > 0.5)[:, 0]
    artefact = FootprintArtefact(
        session_id=drawn.header.session_id,
        source=str(drawn.header.source),
        recording_sha256=drawn.recording_sha256,
        calibration=drawn.calibration.digest,
        software=f"brushloop {version('brushloop')}",
        values=dict(zip(NAMES, found.values, strict=True)),
        images=len(drawn.ink),
        strokes=len(drawn.paths),
        csim_percent=round(100.0 * float(agreement.mean()), 3),
    )
    return artefact, put_to_use(artefact, session, FOLDER)


def load_footprint(path: Path) -> FootprintArtefact:
    """Read a fitted footprint. Raises `CalibrationError`."""
    return load_artefact(path, FootprintArtefact)
