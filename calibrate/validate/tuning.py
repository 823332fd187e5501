"""Captured presses in a generator's image format, for `brushloop train tune`, and a generator judged on unseen cells.

It is judged on cells that it was not tuned on: the tuning sees the captures of all other cells and, if the session was
fitted, images of the CCD-BSM fitted to those same captures, as the paper's generator learns from CCD-BSM. Each fold of
cells has its own tuning, in a folder named after a hash of its inputs; a killed one resumes from its checkpoint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brushloop.calibrate.compare.place import FINE, Field, Image, averaged, brush_of
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.presses import Refused, prepare_press
from brushloop.calibrate.report import source_label
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stroke import PX_PER_MM
from brushloop.calibrate.stroke.preprocess import Prepared
from brushloop.calibrate.work import key_of
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

    label = source_label(sessions[0].header.source, (session.header.brush for session in sessions))
    targets = [load_generator(generator, brush_of(session.header)).target for session in sessions]
    aligned = AlignedPresses(targets[0], label, [], [], [])
    for session, target in zip(sessions, targets, strict=True):
        for capture in session.recording.captures():
            stroke = capture.stroke
            if stroke.depth_mm is None or stroke.tilt_deg is None:
                aligned.left_out.append((stroke.stroke_id, "has no depth or tilt"))
                continue
            if capture.bad:
                aligned.left_out.append((stroke.stroke_id, capture.bad))
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
        images = np.concatenate([images, target.images(drawn, fitted_model(fit))])
        inputs = np.concatenate([inputs, drawn])
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
    from brushloop.model.generator.data import TuningFiles
    from brushloop.model.generator.train import run_training

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

            tuning = TuningFiles(generator, captures)
            settings = {"learning_rate": LEARNING_RATE, "validate_every": max(1, steps // 4), "picture_every": steps}
            run_training(tuning.config(HELD_OUT, steps=steps, seed=0, **settings), folder, stepped, tuning)
        files |= dict.fromkeys(fold, path)
    return files


def _placed(prepared: Prepared, target: Target) -> Image:
    """(N, N) share of ink in each pixel of the generator. Raises `CaptureRefused` if the stroke does not fit."""
    step_px = target.px_mm * PX_PER_MM
    side_px = target.size_px * step_px
    assert prepared.anchor_px is not None  # prepare_press aligns every press with its point of touch
    if target.placement is Placement.CENTRED:
        rows, columns = (np.flatnonzero(prepared.mask.any(axis=axis)) for axis in (1, 0))
        left, top = (0.5 * (ends[0] + ends[-1] + 1 - side_px) for ends in (columns, rows))
    else:
        left, top = (at - share * side_px for at, share in zip(prepared.anchor_px, ANCHOR_SHARE, strict=True))
    # At least as fine as the mask itself, else thin ink would fall between the samples.
    fine = max(FINE, math.ceil(step_px))
    coverage = averaged(prepared.mask.astype(np.float32), (float(left), float(top)), step_px, target.size_px, fine)
    image = np.clip(coverage, 0.0, 1.0)
    inked_px = float(np.count_nonzero(prepared.mask))
    if abs(float(image.sum()) * step_px**2 - inked_px) > 0.01 * inked_px:
        raise CaptureRefused("capture", "is larger than the generator's image")
    return image
