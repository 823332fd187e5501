"""Captured presses in a generator's image format, for `brushloop train tune`, and a generator judged on unseen cells.

It is judged on cells that it was not tuned on: the tuning sees the captures of all other cells and, if the session was
fitted, images of the CCD-BSM fitted to those same captures, as the paper's generator learns from CCD-BSM. Each fold of
cells has its own tuning, in a folder named after a hash of its inputs; a killed one resumes from its checkpoint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import FINE, Field, Image, brush_of, prepare_press
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.report import source_label
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.store import key_of
from brushloop.calibrate.stroke.params import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import Prepared
from brushloop.calibrate.validate.inputs import one_source
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.model.generator.config import ANCHOR_SHARE, INPUTS, Placement, Target
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress

if TYPE_CHECKING:
    from brushloop.model.generator.train import Validation

FOLDS = 5
"""Number of folds: cells are left out by fifths, since a tuning takes a minute."""
LEARNING_RATE = 2e-3
NO_CELL = Condition(-1.0, -1.0)
"""Cell of an image that is not a capture, so that it is never left out."""
IMAGES = 400
"""Number of images of the fitted CCD-BSM added to the captures; drawn evenly from the generator's ranges."""
HELD_OUT = 0.1
"""Share of the captures that is not tuned on; used only for the training's curve."""


@dataclass(frozen=True, slots=True)
class AlignedStrokes:
    """Captured presses in a generator's image format."""

    px_mm: float
    placement: str
    source: str
    images: list[Image]
    """(N, N) each."""
    inputs: list[dict[str, float]]
    cells: list[Condition]
    left_out: list[tuple[str, str]]
    """(stroke, why) of presses that the generator does not draw or that cannot be used."""


def align_captures(sessions: Sequence[OpenSession], generator: Path) -> AlignedStrokes:
    """Convert the presses of sessions to the generator's image format. Raises what `load_generator` raises."""
    from brushloop.model.generator.stroke import load_generator

    target = load_generator(generator).target
    label = source_label(one_source(sessions), (session.header.brush for session in sessions))
    aligned = AlignedStrokes(target.px_mm, str(target.placement), label, [], [], [], [])
    for session in sessions:
        model = load_generator(generator, brush_of(session.header))
        for capture in session.recording.captures():
            stroke = capture.stroke
            if stroke.depth_mm is None or stroke.tilt_deg is None:
                aligned.left_out.append((stroke.stroke_id, "has no depth or tilt"))
                continue
            try:
                values: dict[str, float] = dict(zip(INPUTS, (stroke.depth_mm, stroke.tilt_deg), strict=True))
                model.target.check(np.array([list(values.values())]))
                prepared = prepare_press(capture, session.calibration, Field())
                if prepared.cut:
                    raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph or cell")
                aligned.images.append(_placed(prepared, model.target))
            except (CaptureRefused, SessionDamaged) as error:
                aligned.left_out.append((stroke.stroke_id, error.what))
                continue
            except DomainError as error:
                aligned.left_out.append((stroke.stroke_id, f"the generator does not draw it: {error}"))
                continue
            aligned.inputs.append(values)
            aligned.cells.append(Condition(stroke.depth_mm, stroke.tilt_deg))
    return aligned


def write_captures(aligned: AlignedStrokes, out: Path, leave_out: Sequence[Condition] = ()) -> int:
    """Write the file for `brushloop train tune`, without some cells; return the number of presses.

    Raises `CalibrationError` if fewer than two conditions are left.
    """
    from brushloop.model.generator.data import save_captures

    chosen = [k for k, cell in enumerate(aligned.cells) if cell not in leave_out]
    conditions = len({tuple(aligned.inputs[k].values()) for k in chosen})
    if conditions < 2:
        raise CalibrationError(str(out), f"{conditions} conditions are left, at least 2 are needed to tune on")
    columns = {name: [aligned.inputs[k][name] for k in chosen] for name in aligned.inputs[0]}
    stack = np.stack([aligned.images[k] for k in chosen]).astype(np.float32)
    out.parent.mkdir(parents=True, exist_ok=True)
    save_captures(out, columns, stack, aligned.px_mm, aligned.placement, aligned.source)
    return len(chosen)


def tuned_by_cell(
    session: OpenSession,
    folds: Sequence[tuple[Sequence[Condition], FittedPress | None]],
    generator: Path,
    steps: int,
    work: Path,
    progress: Progress,
) -> dict[Condition, Path]:
    """File of the generator tuned without each cell, by cell; empty for fewer than two cells.

    `folds` are the cells that are left out together and the brush that was fitted without them, None for a session
    without a fit. Raises what `load_generator` and training raise.
    """
    digest = file_sha256(generator)
    files: dict[Condition, Path] = {}
    aligned: AlignedStrokes | None = None
    for number, (fold, fit) in enumerate(folds):
        brush = () if fit is None else (fit.values, fit.edges, fit.ends)
        inputs = session.sha256, session.calibration_digest, digest, steps, LEARNING_RATE, fold, IMAGES, *brush
        folder = work / "tuned" / key_of("tune", *inputs)[:32]
        path = folder / "generator.safetensors"
        if not path.exists():
            captures = folder / "captures.safetensors"
            if not captures.exists():
                aligned = aligned or align_captures([session], generator)
                write_captures(_with_images(aligned, session, fit, generator), captures, fold)
            what = f"{session.header.session_id}: generator tuned, cells left out by fifths"
            steps_done = _TrainingProgress(progress, what, number * steps, len(folds) * steps)
            _tune(folder, captures, generator, str(session.header.source), steps, steps_done)
        files |= dict.fromkeys(fold, path)
    return files


@dataclass(slots=True)
class _TrainingProgress:
    """Reports the steps of a training; see `model.generator.train.Progress`."""

    progress: Progress
    what: str
    before: int
    total: int

    def stepped(self, step: int, loss: float) -> None:
        self.progress(self.what, self.before + step, self.total)

    def validated(self, validation: Validation) -> None: ...


def _tune(folder: Path, captures: Path, generator: Path, source: str, steps: int, progress: _TrainingProgress) -> None:
    from brushloop.model.generator.data import TuningFiles
    from brushloop.model.generator.train import run_training

    files = TuningFiles(generator, captures)
    config = files.config(
        source,
        HELD_OUT,
        steps=steps,
        learning_rate=LEARNING_RATE,
        seed=0,
        validate_every=steps,
        picture_every=steps,
        checkpoint_every=max(1, steps // 4),
    )
    run_training(config, folder, progress, lambda: False, files)


def _with_images(
    aligned: AlignedStrokes, session: OpenSession, fit: FittedPress | None, generator: Path
) -> AlignedStrokes:
    """Add images of the fitted brush, if there is one."""
    from brushloop.model.fitted import fitted_model
    from brushloop.model.generator.stroke import load_generator

    brush = brush_of(session.header)
    target = load_generator(generator, brush).target
    if fit is None:
        return aligned
    fitted = fitted_model(fit)
    inputs = target.draw(IMAGES, (0,))
    return replace(
        aligned,
        images=[*aligned.images, *target.images(inputs, fitted)],
        inputs=[*aligned.inputs, *(dict(zip(INPUTS, row, strict=True)) for row in inputs.tolist())],
        cells=[*aligned.cells, *[NO_CELL] * IMAGES],
    )


def _placed(prepared: Prepared, target: Target) -> Image:
    """(N, N) share of ink in each pixel of the generator. Raises `CaptureRefused` if the stroke does not fit."""
    side_mm = target.size_px * target.px_mm
    assert prepared.anchor_px is not None  # prepare_press aligns every press with its point of touch
    if target.placement is Placement.CENTRED:
        rows, columns = (np.flatnonzero(prepared.mask.any(axis=axis)) for axis in (1, 0))
        middle = (columns[0] + columns[-1] + 1) / 2 / PX_PER_MM, (rows[0] + rows[-1] + 1) / 2 / PX_PER_MM
        corner = middle[0] - side_mm / 2, middle[1] - side_mm / 2
    else:
        anchor = (prepared.anchor_px[0] / PX_PER_MM, prepared.anchor_px[1] / PX_PER_MM)
        corner = anchor[0] - ANCHOR_SHARE[0] * side_mm, anchor[1] - ANCHOR_SHARE[1] * side_mm
    image = _resampled(prepared.mask, corner, target.px_mm, target.size_px)
    inked = float(np.count_nonzero(prepared.mask)) / PX_PER_MM**2
    if abs(float(image.sum()) * target.px_mm**2 - inked) > 0.01 * inked:
        raise CaptureRefused("capture", "is larger than the generator's image")
    return image


def _resampled(mask: NDArray[np.bool_], corner_mm: tuple[float, float], px_mm: float, size_px: int) -> Image:
    """Average the mask, from this upper left corner, over the pixels of a coarser raster."""
    # At least as fine as the mask itself, else thin ink would fall between the samples.
    fine_px = max(FINE, math.ceil(px_mm * PX_PER_MM))
    scale = fine_px / (px_mm * PX_PER_MM)
    # cv2 puts pixel centres on integers, a pixel here covers [j, j + 1).
    move = np.array(
        [
            [scale, 0.0, scale * (0.5 - corner_mm[0] * PX_PER_MM) - 0.5],
            [0.0, scale, scale * (0.5 - corner_mm[1] * PX_PER_MM) - 0.5],
        ]
    )
    fine = cv2.warpAffine(mask.astype(np.float32), move, (fine_px * size_px, fine_px * size_px), flags=cv2.INTER_LINEAR)
    small = cv2.resize(fine, (size_px, size_px), interpolation=cv2.INTER_AREA)
    return np.clip(cast("Image", small), 0.0, 1.0)
