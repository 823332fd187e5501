"""Presses recovered from captures: each stroke on the millimetre field, inverted in batches, with its interval.

The fit is to the coverage of the stroke's mask: its share of each pixel of the 128 x 128 field. The recovered
(H, alpha) is the press for which this model makes this mark. It measures the actual press only as well as the model
describes the brush.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import Field, Image, brush_of, covered, prepare_press
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stats import student_95
from brushloop.calibrate.stroke.params import PX_PER_MM
from brushloop.model.brush import DomainError
from brushloop.model.inversion.noise import Noise
from brushloop.model.inversion.press import Flag, Inverter, Range
from brushloop.model.protocol import Basis, StrokeModel
from brushloop.model.strokes import UnknownModelError, stroke_model
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Header, Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

_T = TypeVar("_T")
NO_MODEL_ERROR = "no_model_error"
"""Flag of a press whose standard deviations leave out the error of the model."""
NOT_INFORMATIVE = {"H": "depth_not_informative", "alpha": "tilt_not_informative"}
"""Flags of a value whose 95 % interval covers most of the range that was commanded in the session."""
MOST = 0.8
"""Share of that range from which on an interval is not informative."""
BATCH = 64
USELESS = frozenset({Flag.BLANK, Flag.DID_NOT_CONVERGE, Flag.CUT})
"""Flags that exclude a stroke: it is listed with the reason and not pressed again."""
Floats = NDArray[np.float64]
Cell = tuple[float, float]
"""Depth in mm and tilt in deg."""
LEAST_CELLS = 3
"""With fewer other cells, the model error is unknown."""
NORMAL_95 = 1.96
ROUNDS = 100


@dataclass(frozen=True, slots=True)
class Settings:
    """How captures are inverted."""

    model: str = "ccd-bsm"
    fitted: StrokeModel | None = None
    """A calibrated brush, which replaces `model`."""
    fitted_cells: frozenset[Cell] = frozenset()
    """The cells that it was fitted to, where they are known."""
    lam: float | None = None
    """lambda of CCD-BSM; None is pi, the default of the paper."""
    within: Range = field(default_factory=Range)
    anchor_sigma_mm: float = 0.1
    """Standard deviation of the zero-touch point; 0 if it is known exactly."""
    view: Field = field(default_factory=Field)


@dataclass(frozen=True, slots=True)
class Row:
    """One recovered stroke."""

    stroke_id: str
    depth_mm: float
    tilt_deg: float
    depth_sd_mm: float
    tilt_sd_deg: float
    rms: float
    flags: tuple[str, ...]
    commanded_depth_mm: float | None
    commanded_tilt_deg: float | None


@dataclass(frozen=True, slots=True)
class Inversion:
    """Presses recovered from a recording."""

    header: Header
    recording: Path
    recording_sha256: str
    settings: Settings
    rows: list[Row]
    refused: list[tuple[str, str]]
    """(stroke, reason) of each stroke that was not recovered."""


@dataclass(frozen=True, slots=True)
class AlignedStroke:
    """A stroke on its field: coverage, and the anchor in mm from the left and top edge."""

    stroke: Stroke
    image: Image
    place_mm: tuple[float, float]


def invert_recording(
    session: Path,
    settings: Settings,
    calibration_path: Path | None,
    presses: int | None = None,
    progress: Progress = unseen,
) -> Inversion:
    """Recover every press of a session, or `presses` of them, spread evenly over the order in which they were made.

    Raises `CalibrationError` if the session is not calibrated or holds no press.
    """
    recording = Recording(session)
    digest = recording.sha256
    strokes = list(recording.stroke_records())
    if not strokes:
        raise CalibrationError(str(recording.path), "holds no strokes")
    if any(stroke.kind != "press" for stroke in strokes):
        raise CalibrationError(str(recording.path), "holds drags: only presses are inverted")
    calibration = calibration_of(recording, strokes[0], digest, calibration_path)
    made = Inversion(recording.header, recording.path, digest, settings, [], [])
    inverter = _inverter(recording.header, settings)
    waiting: list[AlignedStroke] = []
    chosen = {stroke.stroke_id for stroke in spread(strokes, presses)}
    for capture in counted(recording.captures(), "presses recovered", len(strokes), progress):
        if capture.stroke.stroke_id not in chosen:
            continue
        try:
            waiting.append(align(capture, calibration, settings.view))
        except (CaptureRefused, SessionDamaged) as error:
            made.refused.append((capture.stroke.stroke_id, error.what))
            continue
        if len(waiting) == BATCH:
            _invert(made, inverter, waiting)
            waiting = []
    _invert(made, inverter, waiting)
    order = {stroke.stroke_id: number for number, stroke in enumerate(strokes)}
    made.rows.sort(key=lambda row: order[row.stroke_id])
    made.rows[:] = with_model_error(made.rows, settings.fitted_cells)
    return made


def with_model_error(rows: Sequence[Row], fitted: Collection[Cell] = ()) -> list[Row]:
    """The rows with the model error added to their standard deviations, and flags for unknown or wide intervals.

    `fitted` are the cells that the model was fitted to.
    """
    nan = float("nan")
    cells = [(row.commanded_depth_mm or 0.0, row.commanded_tilt_deg or 0.0) for row in rows]
    deep = np.array([nan if (h := row.commanded_depth_mm) is None else row.depth_mm - h for row in rows])
    tilted = np.array([nan if (a := row.commanded_tilt_deg) is None else row.tilt_deg - a for row in rows])
    height_sd = np.array([row.depth_sd_mm for row in rows])
    tilt_sd = np.array([row.tilt_sd_deg for row in rows])
    known = [
        cell for cell, one, other in zip(cells, deep, tilted, strict=True) if np.isfinite(one) and np.isfinite(other)
    ]
    more_mm = model_sd(deep, height_sd, cells, fitted)
    # alpha follows from the distance H tan(alpha), in which the model errs by so many mm whatever the depth. An upright
    # press that was recovered at 0, the end of the range, does not show its error.
    depth = np.array([row.depth_mm for row in rows])
    shown = np.where(tilted == 0.0, nan, tilted)
    more_deg = model_sd(shown * depth, tilt_sd * depth, cells, fitted) / depth
    out: list[Row] = []
    for k, row in enumerate(rows):
        flags = set(row.flags)
        if np.isnan(more_mm[k]) or np.isnan(more_deg[k]):
            flags.add(NO_MODEL_ERROR)
        else:
            wider = float(np.hypot(row.tilt_sd_deg, more_deg[k]))
            row = replace(row, depth_sd_mm=float(np.hypot(row.depth_sd_mm, more_mm[k])), tilt_sd_deg=wider)
        for name, (value, sd, among) in {
            "H": (row.depth_mm, row.depth_sd_mm, [cell[0] for cell in known]),
            "alpha": (row.tilt_deg, row.tilt_sd_deg, [cell[1] for cell in known]),
        }.items():
            if covers_most(value, sd, among):
                flags.add(NOT_INFORMATIVE[name])
        out.append(replace(row, flags=tuple(sorted(flags))))
    return out


def covers_most(value: float, sd: float, commanded: Sequence[float]) -> bool:
    """Whether a 95 % interval, cut to the range of the commanded values, covers most of that range."""
    low, high = min(commanded, default=0.0), max(commanded, default=0.0)
    covered = min(value + NORMAL_95 * sd, high) - max(value - NORMAL_95 * sd, low)
    return high > low and covered > MOST * (high - low)


def spread(strokes: Sequence[_T], most: int | None) -> Sequence[_T]:
    """At most `most` strokes at even distances; all of them if it is None."""
    if most is None or most >= len(strokes):
        return strokes
    return [strokes[number * len(strokes) // most] for number in range(most)]


def align(capture: Capture, calibration: Calibration | None, view: Field) -> AlignedStroke:
    """Place a capture on the field, by the calibration or by the import's own scale. Raises `CaptureRefused`."""
    stroke, prepared = capture.stroke, prepare_press(capture, calibration, view)
    if prepared.cut:
        raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph, cell or field")
    assert prepared.anchor_px is not None, "`prepare_press` refuses a stroke without one"
    x_px, y_px = prepared.anchor_px
    return AlignedStroke(stroke, covered(prepared), (x_px / PX_PER_MM, y_px / PX_PER_MM))


def _invert(made: Inversion, inverter: Inverter, batch: list[AlignedStroke]) -> None:
    """Invert a batch, and file each stroke as recovered or refused."""
    if not batch:
        return
    images = np.stack([aligned.image for aligned in batch])
    heading = np.array([aligned.stroke.heading_deg for aligned in batch])
    found = inverter(images, np.array([aligned.place_mm for aligned in batch]), heading)
    for k, aligned in enumerate(batch):
        stroke, flags = aligned.stroke, found.flags[k]
        ident = stroke.stroke_id
        if useless := sorted(flags & USELESS):
            made.refused.append((ident, ", ".join(useless)))
            continue
        if problem := _unnameable(ident, {row.stroke_id for row in made.rows}):
            made.refused.append((ident, problem))
            continue
        made.rows.append(
            Row(
                ident, float(found.values[k, 0]), float(found.values[k, 1]), float(found.sigma[k, 0]),
                float(found.sigma[k, 1]), float(found.rms[k]), tuple(sorted(flags)), stroke.depth_mm, stroke.tilt_deg,
            )
        )  # fmt: skip


def _unnameable(ident: str, taken: set[str]) -> str:
    """Reason why a protocol cannot press a stroke of this name again; empty if it can."""
    if ident in taken:
        return "its name is that of another stroke too"
    if not 1 <= len(ident) <= 100 or not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident):
        return "its name cannot stand in a protocol"
    return "its name cannot stand in a protocol" if ident[0] in ".-~" else ""


def _inverter(header: Header, settings: Settings) -> Inverter:
    brush = brush_of(header)
    basis = Basis(brush) if settings.lam is None else Basis(brush, settings.lam)
    options = {"within": settings.within, "noise": Noise.BLOCKS, "px_mm": settings.view.mm_per_px}
    options |= {"anchor_sigma_mm": settings.anchor_sigma_mm}
    try:
        if settings.fitted is None and settings.model == "ccd-bsm":
            return Inverter.of_brush(basis, **options)
        model = settings.fitted or stroke_model(settings.model, brush, basis.lam)
        return Inverter.of_model(model, **options)
    except UnknownModelError as error:
        raise CalibrationError("--model", str(error)) from None
    except DomainError as error:
        raise CalibrationError("--depth-range, --tilt-range", str(error)) from None


def off_command(rows: list[Row]) -> Iterator[tuple[str, float, float | None, float, int]]:
    """Yield (parameter, mean of recovered - commanded, standard deviation, share in the 95 % interval, n).

    A single press has no standard deviation: None.
    """
    pairs = {
        "H": [(r.depth_mm, r.depth_sd_mm, r.commanded_depth_mm) for r in rows],
        "alpha": [(r.tilt_deg, r.tilt_sd_deg, r.commanded_tilt_deg) for r in rows],
    }
    for name, found in pairs.items():
        known = [(value - asked, sd) for value, sd, asked in found if asked is not None]
        if known:
            off, sd = (np.array(part, np.float64) for part in zip(*known, strict=True))
            inside = np.abs(off) <= NORMAL_95 * sd
            scatter = float(off.std(ddof=1)) if len(off) > 1 else None
            yield name, float(off.mean()), scatter, float(inside.mean()), len(off)


def model_sd(off: Floats, sd: Floats, cells: list[Cell], fitted: Collection[Cell] = ()) -> Floats:
    """Standard deviation of the model error of N presses, (N,); NaN where too few other cells are known.

    `off` (N,) is recovered - commanded, NaN where no command is known; `sd` (N,) is the standard deviation from the
    image alone. `fitted` are the cells that the brush was fitted to. The result is enlarged by Student's t with a
    degree of freedom for each cell, so that 1.96 times it covers 95 % with few cells.
    """
    out = np.full(len(off), np.nan)
    known = np.isfinite(off) & np.isfinite(sd)
    for cell in set(cells):
        others = [k for k, other in enumerate(cells) if other != cell and known[k]]
        unseen = [] if cell in fitted else [k for k in others if cells[k] not in fitted]
        found = [_spread(off[k], sd[k], len({cells[at] for at in k})) for k in (others, unseen) if k]
        if len({cells[k] for k in others}) >= LEAST_CELLS:
            out[[k for k, other in enumerate(cells) if other == cell]] = max(found)
    return out


def common_variance(off: Floats, sd: Floats) -> float:
    """The variance v for which the mean of off^2 / (sd^2 + v) is 1; 0 where the deviations `sd` alone explain `off`.

    A press that its image hardly determines counts little, however large its deviation.
    """
    variance = 0.0
    square = np.maximum(sd**2, 1e-12)
    for _ in range(ROUNDS):  # Newton's method, which approaches the root of a convex function from below
        weight = 1.0 / (square + variance)
        excess = float(np.mean(off**2 * weight)) - 1.0
        if excess < 1e-9:
            break
        variance += excess / float(np.mean((off * weight) ** 2))
    return variance


def _spread(off: Floats, sd: Floats, cells: int) -> float:
    """The deviation from presses of so many cells, enlarged; 0 from too few."""
    if cells < LEAST_CELLS:
        return 0.0
    return math.sqrt(common_variance(off, sd)) * student_95(cells) / NORMAL_95
