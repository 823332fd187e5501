"""Captured presses in a generator's image format, for `brushloop train tune`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from brushloop.calibrate.commands import CapturesRequest
from brushloop.calibrate.compare import FINE, Image, averaged, brush_of
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.files import Written, check_target
from brushloop.calibrate.presses import Refused, prepare_press
from brushloop.calibrate.report import source_label
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stroke import PX_PER_MM, Prepared
from brushloop.calibrate.validate.command import one_source, open_session
from brushloop.model.ccdbsm import DomainError
from brushloop.model.generator.config import ANCHOR_SHARE, INPUTS, Placement, Target
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, unseen


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


def captures(request: CapturesRequest, _progress: Progress = unseen) -> Written:
    """Write the presses of sessions of one source for `brushloop train tune`. Raises `CalibrationError`."""
    check_target(request.out, ".safetensors", request.generator)
    sessions = [open_session(place) for place in request.sessions]
    one_source(sessions)
    aligned = align_captures(sessions, request.generator)
    write_captures(aligned, request.out)
    left_out = [f"left out: {name}: {why}" for name, why in aligned.left_out]
    return Written(request.out, (*left_out, f"{len(aligned.images)} presses ({aligned.source}): {request.out}"))


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
                prepared = prepare_press(capture, session.calibration)
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


def write_captures(aligned: AlignedPresses, out: Path) -> None:
    """Write the file for `brushloop train tune`. Raises `CalibrationError` for fewer than two conditions."""
    from brushloop.model.generator.data import save_captures

    target, conditions = aligned.target, len(set(aligned.conditions))
    if conditions < 2:
        raise CalibrationError(str(out), f"{conditions} conditions are left, at least 2 are needed to tune on")
    out.parent.mkdir(parents=True, exist_ok=True)
    inputs = [(at.depth_mm, at.tilt_deg) for at in aligned.conditions]
    columns = dict(zip(INPUTS, map(list, zip(*inputs, strict=True)), strict=True))
    images = np.array(aligned.images, np.float32)
    save_captures(out, columns, images, target.px_mm, str(target.placement), aligned.source)


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
