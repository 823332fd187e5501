"""Show what becomes of a photograph on the way to a 128 x 128 stroke, and write the numbers fitted in each stage."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import Field, Tone, captured_mm, crop, crop_at_anchor, rectified
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_gray, write_whole
from brushloop.calibrate.report import picture_grid, printable, save_picture, show_picture
from brushloop.calibrate.session import calibration_of
from brushloop.calibrate.stroke.difference import new_stroke
from brushloop.calibrate.stroke.params import PX_PER_MM, Gray, Mask, Params, Soft
from brushloop.calibrate.stroke.preprocess import Steps, preprocess, to_levels
from brushloop.calibrate.stroke.rectify import on_raster, rescale
from brushloop.sessions.recording import Capture, Recording
from brushloop.sessions.records import Topic
from brushloop.sessions.terminal import Progress, counted, unseen

COLUMNS = 4
TITLE_CHARS = 52


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage: its name, its image (gray, 0 = black) and the numbers that were fitted or counted in it."""

    name: str
    image: Gray
    values: dict[str, float]


@dataclass(frozen=True, slots=True)
class Trace:
    """The stages of a capture; the last is the image that a validation compares."""

    where: str
    stages: tuple[Stage, ...]
    flags: tuple[str, ...]
    params: Params

    @property
    def log(self) -> dict[str, float]:
        """Every fitted number as `stage.name`."""
        return {f"{stage.name}.{name}": value for stage in self.stages for name, value in stage.values.items()}


def show_stroke(session: Path, stroke: str, out: Path, progress: Progress = unseen) -> Trace:
    """Show a stroke of a session by its name, or the first one if the name is empty, as a validation sees it.

    Raises `CalibrationError` where the session was not calibrated.
    """
    recording = Recording(session)
    for capture in counted(recording.captures(), "strokes read", recording.counts[Topic.STROKE], progress):
        if stroke in ("", capture.stroke.stroke_id):
            break
    else:
        raise CalibrationError(str(recording.path), f"holds no stroke {stroke!r}")
    calibration = calibration_of(recording, capture.stroke, recording.sha256, None)
    return _written(trace_capture(capture, calibration, f"{recording.path.name} {capture.stroke.stroke_id}"), out)


def show_photograph(path: Path, px_per_mm: float | None, before: Path | None, out: Path) -> Trace:
    """Show a flat photograph of known scale; with a page `before` it, only the new ink. Raises `CalibrationError`."""
    if px_per_mm is None:
        raise CalibrationError(str(path), "is a photograph: give --px-per-mm")
    image = read_gray(path)
    if before is not None:
        image = _gray(new_stroke(read_gray(before), image, px_per_mm, str(path)).soft)
    return _written(trace_scaled(image, (px_per_mm, px_per_mm), None, str(path), Params()), out)


def trace_capture(capture: Capture, calibration: Calibration | None, where: str) -> Trace:
    """Trace a capture of a session, as `rectified` crops it, or as an import brings it. Raises `CaptureRefused`."""
    image = capture.image()
    raster, steps = rectified(capture, calibration, Field())
    before, fitted = [_captured(image)], dict[str, float]()
    if calibration is not None:
        lens = calibration.lens
        terms: dict[str, float] = dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.distortion, strict=True))
        before.append(Stage("undistort", lens.undistort(image), terms))
        fitted = {"pix2len_mm_per_px": calibration.mm_per_px, "rms_px": calibration.rms_px}
    before.append(Stage("rectify", raster, {"px_per_mm": PX_PER_MM} | fitted))
    return _traced(steps, where, Params.of(calibration), before)


def trace_scaled(
    image: Gray, px_per_mm: tuple[float, float], anchor_px: tuple[float, float] | None, where: str, params: Params
) -> Trace:
    """Trace a flat photograph of known scale. Raises `CaptureRefused`."""
    raster = rescale(image, px_per_mm, where)
    anchor = None if anchor_px is None else on_raster(anchor_px, px_per_mm)
    before = [_captured(image), Stage("rectify", raster, {"px_per_mm": PX_PER_MM})]
    return _traced(preprocess(raster, anchor, where, params), where, params, before)


def _captured(image: Gray) -> Stage:
    return Stage("captured", image, {"width_px": float(image.shape[1]), "height_px": float(image.shape[0])})


def _traced(steps: Steps, where: str, params: Params, before: list[Stage]) -> Trace:
    view, whole, chosen = Field(), steps.prepared, steps.chosen
    if whole.anchor_px is None:
        corner = view.corner_around_px(whole.mask)
        cropped = crop(whole, corner, view)
    else:
        corner, cropped = view.corner_px(whole.anchor_px), crop_at_anchor(whole, whole.anchor_px, view)
    flags = list(whole.flags)
    if np.count_nonzero(cropped.mask) < np.count_nonzero(whole.mask):
        flags.append(f"too long: the stroke does not fit {view.side_mm:g} mm, its ends are cut off")
    level, binary = steps.level, captured_mm(cropped, Tone.BINARY) > 0.5
    contrast = {"reflectance": level.threshold, "contrast": 1.0 - level.darkest, "gate": params.contrast_gate}
    counted_parts = {
        "parts": float(chosen.parts),
        "specks": float(chosen.specks),
        "others": float(len(chosen.others_mm2)),
        "others_mm2": float(sum(chosen.others_mm2)),
        "area_mm2": float(np.count_nonzero(whole.mask)) / PX_PER_MM**2,
    }
    place = {"left_px": float(corner[0]), "top_px": float(corner[1])}
    if cropped.anchor_px is not None:
        place |= {"anchor_x_px": cropped.anchor_px[0], "anchor_y_px": cropped.anchor_px[1]}
    scale = {"mm_per_px": view.mm_per_px, "area_mm2": float(binary.sum()) * view.mm_per_px**2}
    after = (
        Stage("flatten", to_levels(steps.reflectance), {"background_mm": params.background_mm}),
        Stage("threshold", _shade(steps.ink), contrast),
        Stage("components", _shade(whole.mask, steps.ink), counted_parts),
        Stage("crop", _cross(_gray(cropped.soft), cropped.anchor_px), place),
        Stage("resize", _shade(binary), scale),
    )
    return Trace(where, (*before, *after), tuple(flags), params)


def _written(trace: Trace, out: Path) -> Trace:
    """Write a PNG with a picture of each stage, its numbers above and the flags below, and the numbers as JSON."""
    rows = -(-len(trace.stages) // COLUMNS)
    figure, axes = picture_grid(rows, COLUMNS, (12.4, 3.8 * rows + 0.2 * len(trace.flags)))
    for axis in axes.flat[len(trace.stages) :]:
        axis.axis("off")
    for number, (axis, stage) in enumerate(zip(axes.flat, trace.stages, strict=False), start=1):
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in stage.values.items())
        title = textwrap.fill(f"{number} {stage.name}: {numbers}", TITLE_CHARS)
        show_picture(axis, (1.0 - stage.image / 255.0).astype(np.float32), title, fontsize=7)
    figure.supxlabel("\n".join(map(printable, (trace.where, *trace.flags))), fontsize=8)
    save_picture(figure, out)
    record = {"where": trace.where, "params": asdict(trace.params), "fitted": trace.log, "flags": list(trace.flags)}
    write_whole(out.with_suffix(".json"), json.dumps(record, indent=2) + "\n")
    return trace


def _shade(mask: Mask, also: Mask | None = None) -> Gray:
    """Black where the mask is, light gray where only `also` is, white elsewhere."""
    image = np.full(mask.shape, 255, np.uint8)
    if also is not None:
        image[also] = 190
    image[mask] = 0
    return image


def _gray(soft: Soft) -> Gray:
    return np.rint(255.0 * (1.0 - soft)).astype(np.uint8)


def _cross(image: Gray, anchor_px: tuple[float, float] | None) -> Gray:
    drawn = image.copy()
    if anchor_px is not None:
        place = (round(anchor_px[0] - 0.5), round(anchor_px[1] - 0.5))
        cv2.drawMarker(drawn, place, 255, cv2.MARKER_CROSS, 40, 7)
        cv2.drawMarker(drawn, place, 0, cv2.MARKER_CROSS, 40, 3)
    return drawn
