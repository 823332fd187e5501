"""Captured presses as `brushloop train tune` reads them: in the placement and scale that a generator draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from calibrate.compare.field import FINE, Field, Image
from calibrate.compare.presses import prepare_press
from calibrate.compare.simulate import axis_mm, brush_of
from calibrate.errors import CalibrationError, CaptureRefused
from calibrate.stroke.params import PX_PER_MM, Params
from calibrate.stroke.preprocess import Prepared
from calibrate.validate.heldout import Cell
from calibrate.validate.sources import Opened, one_source
from model.ccdbsm import DomainError
from sessions.errors import SessionDamaged

if TYPE_CHECKING:
    from model.generator.stroke import GeneratorModel

MOST_STROKES = 100_000


@dataclass(frozen=True, slots=True)
class Laid:
    """Captured presses as a generator draws them."""

    px_mm: float
    placement: str
    source: str
    images: list[Image]
    """(N, N) each."""
    inputs: list[dict[str, float]]
    cells: list[Cell]
    left_out: list[tuple[str, str]]
    """(stroke, why): what the generator does not draw, or cannot be used."""


def lay_captures(sessions: list[Opened], generator: Path) -> Laid:
    """Every press of some sessions as the generator's own images. Raises what `load_generator` does."""
    from model.train.checkpoint import load_generator

    target = load_generator(generator).target
    laid = Laid(target.px_mm, str(target.placement), str(one_source(sessions)), [], [], [], [])
    for session in sessions:
        brush = brush_of(session.header)
        model = load_generator(generator, brush)
        params = Params(**session.calibration.preprocess) if session.calibration is not None else Params()
        for capture in session.recording.captures():
            stroke = capture.stroke
            if stroke.height_mm is None or stroke.tilt_deg is None:
                laid.left_out.append((stroke.stroke_id, "tells no depth or tilt"))
                continue
            try:
                values = inputs_of(model, stroke.height_mm, stroke.tilt_deg)
                prepared = prepare_press(capture, session.calibration, params, Field())
                if prepared.cut:
                    raise CaptureRefused(stroke.stroke_id, "is cut by the edge of its photograph or cell")
                laid.images.append(placed(prepared, model, values, stroke.height_mm, stroke.tilt_deg))
            except (CaptureRefused, SessionDamaged) as error:
                laid.left_out.append((stroke.stroke_id, error.what))
                continue
            except DomainError as error:
                laid.left_out.append((stroke.stroke_id, f"the generator does not draw it: {error}"))
                continue
            laid.inputs.append(values)
            laid.cells.append((stroke.height_mm, stroke.tilt_deg))
            if len(laid.cells) > MOST_STROKES:
                raise CalibrationError(str(session.recording.path), f"more than {MOST_STROKES} strokes to tune on")
    return laid


def write_captures(laid: Laid, out: Path, leave_out: Sequence[Cell] = ()) -> int:
    """Write the file for `brushloop train tune`, without some cells; returns how many presses are in it.

    Raises `CalibrationError` where fewer than two are left.
    """
    import torch

    from model.train.data import save_captures

    chosen = [k for k, cell in enumerate(laid.cells) if cell not in leave_out]
    if len(chosen) < 2:
        raise CalibrationError(str(out), f"{len(chosen)} strokes are left, at least 2 are needed to tune on")
    columns = {name: torch.tensor([laid.inputs[k][name] for k in chosen]) for name in laid.inputs[0]}
    stack = torch.as_tensor(np.stack([laid.images[k] for k in chosen]))
    out.parent.mkdir(parents=True, exist_ok=True)
    save_captures(out, columns, stack, laid.px_mm, laid.placement, laid.source)
    return len(chosen)


def inputs_of(model: GeneratorModel, height_mm: float, tilt_deg: float) -> dict[str, float]:
    """The generator's inputs for a press of its brush. Raises DomainError for one outside its training."""
    values = {name: float(value[0]) for name, value in model.of_press(height_mm, tilt_deg).items()}
    out: dict[str, float] = {}
    for spec in model.target.inputs:
        value = values.get(spec.name, spec.default)
        if not spec.low <= value <= spec.high:
            raise DomainError(spec.name, value, f"[{spec.low:g}, {spec.high:g}]", "what the generator was trained for")
        out[spec.name] = value
    return out


def placed(
    prepared: Prepared, model: GeneratorModel, values: dict[str, float], height_mm: float, tilt_deg: float
) -> Image:
    """(N, N) share of each of the generator's pixels that is ink. Raises `CaptureRefused` where it does not fit."""
    from model.generator.targets import ANCHOR_SHARE, Placement

    target = model.target
    side_mm = target.size_px * target.px_mm
    assert prepared.anchor_px is not None  # prepare_press lays every press on its point of touch
    anchor = (prepared.anchor_px[0] / PX_PER_MM, prepared.anchor_px[1] / PX_PER_MM)
    match target.placement:
        case Placement.CENTRED:
            rows, columns = (np.flatnonzero(prepared.mask.any(axis=axis)) for axis in (1, 0))
            middle = (columns[0] + columns[-1] + 1) / 2 / PX_PER_MM, (rows[0] + rows[-1] + 1) / 2 / PX_PER_MM
            corner = middle[0] - side_mm / 2, middle[1] - side_mm / 2
        case Placement.ZERO_TOUCH:
            corner = anchor[0] - ANCHOR_SHARE[0] * side_mm, anchor[1] - ANCHOR_SHARE[1] * side_mm
        case Placement.BASE:
            fixed = target.fixed
            base = tuple(values.get(name, fixed.get(name, 0.0)) for name in ("base_x_mm", "base_y_mm"))
            corner = anchor[0] + axis_mm(height_mm, tilt_deg) - base[0], anchor[1] - base[1]
    image = _resampled(prepared.mask, corner, target.px_mm, target.size_px)
    inked = float(np.count_nonzero(prepared.mask)) / PX_PER_MM**2
    if abs(float(image.sum()) * target.px_mm**2 - inked) > 0.01 * inked:
        raise CaptureRefused("capture", "is larger than the generator's image")
    return image


def _resampled(mask: NDArray[np.bool_], corner_mm: tuple[float, float], px_mm: float, size_px: int) -> Image:
    """The window of the mask with this upper left corner, averaged over the pixels of a coarser raster."""
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
