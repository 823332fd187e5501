"""The dragged footprint of a brush, fitted to written figures, as a file that plans are made with."""

from __future__ import annotations

import math
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import SessionFit, load_artefact, put_to_use
from brushloop.calibrate.compare.place import SIZE_PX
from brushloop.calibrate.compare.score import binary_scores
from brushloop.calibrate.drags.captures import read_drags
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing.plan_files import figure_record, write_record
from brushloop.calibrate.writing.plan_record import FigureRecord, PlannedBy, PlanRecord
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.plan import directions
from brushloop.model.footprint import NAMES, Footprint, fit_footprint
from brushloop.sessions.terminal import Progress, unseen

FOLDER = "footprint"
MM_PER_PX = 0.5
LEAST = 3
"""Least number of strokes: fewer do not distinguish the discs."""
Floats = NDArray[np.float64]
FIGURES, PER_FIGURE = 10, 2
MARGIN = 0.22
"""Share of the cell at each side that is kept free: ink lands behind its command, and must not reach the edge."""
DEEPEST = 0.3
"""Greatest depth as a share of the brush's length."""
MM_BETWEEN = 2.0
TILT_DEG = 5.0
NAME = "practice"


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


def practice_strokes(side_mm: float, reach: Reach, brush_length_mm: float, seed: int = 1) -> list[Floats]:
    """`FIGURES` x `PER_FIGURE` trajectories (N, 5) on a cell of that side; every third has a sharp turn.

    None is deeper than `DEEPEST` of the brush's length.
    """
    rng = np.random.default_rng(seed)
    deepest_mm = min(reach.depth_mm[1], math.floor(DEEPEST * brush_length_mm))
    room_mm = (1.0 - 2.0 * MARGIN) * side_mm
    out: list[Floats] = []
    while len(out) < FIGURES * PER_FIGURE:
        length_mm = rng.uniform(0.2, 1.0) * room_mm
        count = max(4, round(length_mm / MM_BETWEEN))
        heading = rng.uniform(-180.0, 180.0) + np.cumsum(rng.normal(0.0, 8.0, count))
        if len(out) % 3 == 0:
            heading[count // 2 :] += rng.choice([-1.0, 1.0]) * rng.uniform(50.0, 150.0)
        places = np.cumsum(directions(heading) * length_mm / count, axis=0)
        low, high = places.min(axis=0), places.max(axis=0)
        places += MARGIN * side_mm - low + rng.uniform(0.0, 1.0, 2) * np.maximum(room_mm - (high - low), 0.0)
        depths = rng.uniform(0.1, 1.0, 3) * deepest_mm
        depth = np.interp(np.linspace(0.0, 1.0, count), (0.0, 0.5, 1.0), depths)
        points = np.column_stack((places, depth, np.full(count, TILT_DEG), heading))
        made = reach.spaced(np.round(reach.within(points, side_mm), 3))
        if len(made) >= 3:
            out.append(made)
    return out


def write_practice(out: Path, cell_mm: float, by: PlannedBy, seed: int) -> Path:
    """Write the protocol of a practice sheet, each stroke on a cell of its own; returns its path. Raises OSError."""
    reach = Reach(by.depth_range_mm, by.tilt_range_deg, turn_deg_mm=by.turn_deg_mm)
    blank = np.zeros((SIZE_PX, SIZE_PX), np.float32)
    figures: list[FigureRecord] = []
    strokes = practice_strokes(cell_mm, reach, by.length_mm, seed)
    for number in range(FIGURES):
        some = strokes[number * PER_FIGURE : (number + 1) * PER_FIGURE]
        source = f"practice strokes, seed {seed}"
        figures.append(figure_record(f"{NAME}-{number + 1:02d}", source, some, some, wanted=blank, simulated=blank))
    record = PlanRecord(
        model="none: practice", planned_by=by, cell_mm=cell_mm, software="brushloop", figures=tuple(figures)
    )
    out.mkdir(parents=True, exist_ok=True)
    return write_record(record, 1, out)
