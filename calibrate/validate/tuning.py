"""Captured presses in a generator's image format, for `brushloop train tune`, and a generator judged on unseen cells.

It is judged on cells that it was not tuned on: the tuning sees the captures of all other cells and, if the session was
fitted, images of the CCD-BSM fitted to those same captures, as the paper's generator learns from CCD-BSM. Each fold of
cells has its own tuning, in a folder named after a hash of its inputs; a killed one resumes from its checkpoint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare.place import FINE, Field, Image, brush_of, prepare_press
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.presses import Refused
from brushloop.calibrate.report import source_label
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.store import key_of
from brushloop.calibrate.stroke.params import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import Prepared
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import FittedPress
from brushloop.model.generator.config import ANCHOR_SHARE, INPUTS, Placement, Target
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress

FOLDS = 5
"""Number of folds: cells are left out by fifths, since a tuning takes a minute."""
LEARNING_RATE = 2e-3
IMAGES = 400
"""Number of images of the fitted CCD-BSM added to the captures; drawn evenly from the generator's ranges."""
HELD_OUT = 0.1
"""Share of the captures that is not tuned on; used only for the training's curve."""


@dataclass(frozen=True, slots=True)
class AlignedPresses:
    """Captured presses in a generator's image format."""

    target: Target
    source: str
    """Label of the recordings."""
    images: list[Image]
    """(N, N) each."""
    conditions: list[Condition]
    left_out: list[Refused]
    """Presses that the generator does not draw or that cannot be used."""


def align_captures(sessions: Sequence[OpenSession], generator: Path) -> AlignedPresses:
    """Convert the presses of sessions of one source to the generator's image format. Raises as `load_generator`."""
    from brushloop.model.generator.stroke import load_generator

    headers = [session.header for session in sessions]
    label = source_label(headers[0].source, (header.brush for header in headers))
    aligned = AlignedPresses(load_generator(generator, brush_of(headers[0])).target, label, [], [], [])
    for session in sessions:
        target = load_generator(generator, brush_of(session.header)).target
        for capture in session.recording.captures():
            stroke = capture.stroke
            if stroke.depth_mm is None or stroke.tilt_deg is None:
                aligned.left_out.append((stroke.stroke_id, "has no depth or tilt"))
                continue
            try:
                target.check(np.array([[stroke.depth_mm, stroke.tilt_deg]]))
                prepared = prepare_press(capture, session.calibration, Field())
                if prepared.cut:
                    raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph or cell")
                image = _placed(prepared, target)
            except (CaptureRefused, SessionDamaged) as error:
                aligned.left_out.append((stroke.stroke_id, error.what))
            except DomainError as error:
                aligned.left_out.append((stroke.stroke_id, f"the generator does not draw it: {error}"))
            else:
                aligned.images.append(image)
                aligned.conditions.append(Condition(stroke.depth_mm, stroke.tilt_deg))
    return aligned


def write_captures(
    aligned: AlignedPresses, out: Path, leave_out: Sequence[Condition] = (), fit: FittedPress | None = None
) -> int:
    """Write the file for `brushloop train tune`, without some cells; return the number of presses.

    With a `fit` of the brush, images that it draws are added. Raises `CalibrationError` if fewer than two conditions
    are left.
    """
    from brushloop.model.fitted import fitted_model
    from brushloop.model.generator.data import save_captures

    target = aligned.target
    chosen = [k for k, condition in enumerate(aligned.conditions) if condition not in leave_out]
    inputs = np.array([(aligned.conditions[k].depth_mm, aligned.conditions[k].tilt_deg) for k in chosen])
    images = np.array([aligned.images[k] for k in chosen])
    if fit is not None:
        drawn = target.draw(IMAGES, (0,))
        inputs, images = (
            np.concatenate([inputs, drawn]),
            np.concatenate([images, target.images(drawn, fitted_model(fit))]),
        )
    conditions = len(np.unique(inputs, axis=0))
    if conditions < 2:
        raise CalibrationError(str(out), f"{conditions} conditions are left, at least 2 are needed to tune on")
    out.parent.mkdir(parents=True, exist_ok=True)
    columns = dict(zip(INPUTS, inputs.T.tolist(), strict=True))
    save_captures(out, columns, images.astype(np.float32), target.px_mm, str(target.placement), aligned.source)
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
    aligned: AlignedPresses | None = None
    for number, (fold, fit) in enumerate(folds):
        brush = () if fit is None else (fit.values, fit.edges, fit.ends)
        inputs = session.sha256, session.calibration_digest, digest, steps, LEARNING_RATE, fold, IMAGES, *brush
        folder = work / "tuned" / key_of("tune", *inputs)[:32]
        path = folder / "generator.safetensors"
        if not path.exists():
            captures = folder / "captures.safetensors"
            if not captures.exists():
                aligned = aligned or align_captures([session], generator)
                write_captures(aligned, captures, fold, fit)
            what = f"{session.header.session_id}: generator tuned, cells left out by fifths"

            def stepped(step: int, what: str = what, before: int = number * steps) -> None:
                progress(what, before + step, len(folds) * steps)

            _tune(folder, captures, generator, steps, stepped)
        files |= dict.fromkeys(fold, path)
    return files


def _tune(folder: Path, captures: Path, generator: Path, steps: int, stepped: Callable[[int], None]) -> None:
    from brushloop.model.generator.data import TuningFiles
    from brushloop.model.generator.train import run_training

    files = TuningFiles(generator, captures)
    config = files.config(
        HELD_OUT,
        steps=steps,
        learning_rate=LEARNING_RATE,
        seed=0,
        validate_every=max(1, steps // 4),
        picture_every=steps,
    )
    run_training(config, folder, stepped, files)


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
