"""Every stage from a photograph to a 128 x 128 stroke, kept for looking at, with what was fitted in each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.board.lens import Gray
from calibrate.board.plane import Plane
from calibrate.compare.field import Field, Tone, captured_mm, crop, crop_at_anchor
from calibrate.errors import CaptureRefused
from calibrate.stroke.components import components, fill_holes
from calibrate.stroke.light import flatten
from calibrate.stroke.params import PX_PER_MM, Mask, Params, Soft
from calibrate.stroke.preprocess import (
    Prepared,
    cell_window,
    find_level,
    on_raster,
    on_window,
    raise_flags,
    rescale,
    soft_ink,
    to_levels,
    touches_edge,
)
from calibrate.stroke.rectify import rectify_distorted


@dataclass(frozen=True, slots=True)
class Stage:
    """One step: what it is called, what it made (gray, 0 = black) and the numbers that were fitted or counted."""

    name: str
    image: Gray
    values: dict[str, float]


@dataclass(frozen=True, slots=True)
class Trace:
    """A capture on its way to a stroke."""

    where: str
    stages: tuple[Stage, ...]
    binary: Mask
    """(128, 128) of the field, True where ink: the image that a validation compares."""
    soft: Soft
    """(128, 128) coverage from 0 to 1."""
    anchor_px: tuple[float, float] | None
    """The zero-touch point on the small image: pixel j covers [j, j + 1). It may lie outside."""
    flags: tuple[str, ...]

    @property
    def log(self) -> dict[str, float]:
        """Every fitted number as `stage.name`."""
        return {f"{stage.name}.{name}": value for stage in self.stages for name, value in stage.values.items()}


def trace_seen(
    image: Gray,
    plane: Plane,
    window_mm: tuple[float, float, float, float],
    anchor_mm: tuple[float, float],
    where: str,
    params: Params,
    cell_mm: tuple[float, float, float, float] | None = None,
) -> Trace:
    """A photograph of a sheet whose plane is known; `window_mm` (x, y, width, height) holds the stroke.

    What lies outside the paper cell is hidden, as `prepare` hides it. Raises `CaptureRefused` as `prepare` does.
    """
    k1, k2, p1, p2, k3 = (float(v) for v in plane.lens.distortion)
    lens = {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
    raster = rectify_distorted(image, plane, window_mm)
    stages = (
        Stage("captured", image, {"width_px": float(image.shape[1]), "height_px": float(image.shape[0])}),
        Stage("undistort", plane.lens.undistort(image), lens),
        Stage(
            "rectify", raster, {"px_per_mm": PX_PER_MM, "pix2len_mm_per_px": plane.mm_per_px, "rms_px": plane.rms_px}
        ),
    )
    left, top = anchor_mm[0] - window_mm[0], window_mm[1] + window_mm[3] - anchor_mm[1]
    cell_px = None if cell_mm is None else on_window(cell_mm, window_mm)
    return _from_raster(raster, (left * PX_PER_MM, top * PX_PER_MM), where, params, stages, cell_px)


def trace_scaled(
    image: Gray, px_per_mm: tuple[float, float], anchor_px: tuple[float, float] | None, where: str, params: Params
) -> Trace:
    """A photograph that is flat and of known scale, as an import brings it. Raises `CaptureRefused`."""
    raster = rescale(image, px_per_mm, where)
    scale = {"from_px_per_mm_x": px_per_mm[0], "from_px_per_mm_y": px_per_mm[1], "px_per_mm": PX_PER_MM}
    stages = (
        Stage("captured", image, {"width_px": float(image.shape[1]), "height_px": float(image.shape[0])}),
        Stage("rectify", raster, scale),
    )
    anchor = None if anchor_px is None else on_raster(anchor_px, px_per_mm)
    return _from_raster(raster, anchor, where, params, stages)


def _from_raster(
    raster: Gray,
    anchor_px: tuple[float, float] | None,
    where: str,
    params: Params,
    before: tuple[Stage, ...],
    cell_px: tuple[int, int, int, int] | None = None,
) -> Trace:
    window = cell_window(raster, cell_px, where)
    reflectance = np.ones(raster.shape, np.float32)
    reflectance[window] = flatten(raster[window], params)
    level = find_level(reflectance[window], where, params)
    levels = to_levels(reflectance)
    ink = levels <= round(255.0 * level.threshold)
    chosen = components(ink, anchor_px, params)
    if not chosen.mask.any():
        raise CaptureRefused(where, "holds no stroke after specks and neighbours were removed")
    mask = fill_holes(chosen.mask, params)
    soft = soft_ink(reflectance, chosen.mask)
    flags = list(raise_flags(raster[window], mask[window], chosen))
    whole, view = Prepared(mask, soft, anchor_px, level.threshold, touches_edge(mask[window])), Field()
    if anchor_px is None:
        corner = _about(mask, view)
        cropped = crop(whole, corner, view)
    else:
        corner, cropped = view.corner_px(anchor_px), crop_at_anchor(whole, anchor_px, view)
    if np.count_nonzero(cropped.mask) < np.count_nonzero(mask):
        flags.append(f"too long: the stroke does not fit {view.side_mm:g} mm, its ends are cut off")
    anchor, binary = cropped.anchor_px, captured_mm(cropped, Tone.BINARY) > 0.5
    shrink = view.mm_per_px * PX_PER_MM
    small_anchor = None if anchor is None else (anchor[0] / shrink, anchor[1] / shrink)
    light = (raster / np.maximum(reflectance, 1e-3)).astype(np.float32)[window]
    after = (
        Stage("light", np.clip(light, 0, 255).astype(np.uint8), _range(light, "gray_level")),
        Stage("flatten", levels, {"background_mm": params.background_mm}),
        Stage(
            "gate",
            _shade(reflectance < 1.0 - params.contrast_gate),
            {"contrast": 1.0 - level.darkest, "gate": params.contrast_gate},
        ),
        Stage("threshold", _shade(ink), {"reflectance": level.threshold}),
        Stage(
            "components",
            _shade(mask, ink),
            {
                "parts": float(chosen.parts),
                "specks": float(chosen.specks),
                "others": float(len(chosen.others_mm2)),
                "others_mm2": float(sum(chosen.others_mm2)),
                "join_mm": params.join_mm,
                "speck_share": params.speck_share,
                "hole_mm2": params.hole_mm2,
            },
        ),
        Stage("crop", _gray(cropped.soft), {"left_px": float(corner[0]), "top_px": float(corner[1])}),
        Stage(
            "anchor",
            _cross(_gray(cropped.soft), anchor),
            {} if anchor is None else {"x_px": anchor[0], "y_px": anchor[1]},
        ),
        Stage("binarise", _shade(cropped.mask), {"area_mm2": float(np.count_nonzero(cropped.mask)) / PX_PER_MM**2}),
        Stage(
            "resize",
            _shade(binary),
            {"mm_per_px": view.mm_per_px, "area_mm2": float(binary.sum()) * view.mm_per_px**2},
        ),
    )
    return Trace(where, (*before, *after), binary, captured_mm(cropped, Tone.GRAY), small_anchor, tuple(flags))


def _about(mask: Mask, view: Field) -> tuple[int, int]:
    """(column, row) of the field's corner where no anchor is known: around the middle of the stroke's box."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = round(view.side_mm * PX_PER_MM)
    return int(columns[0] + columns[-1] + 1 - side) // 2, int(rows[0] + rows[-1] + 1 - side) // 2


def _range(values: Soft, name: str) -> dict[str, float]:
    return {f"{name}_low": float(np.quantile(values, 0.01)), f"{name}_high": float(np.quantile(values, 0.99))}


def _shade(mask: Mask, also: Mask | None = None) -> Gray:
    """Black where the mask is, light gray where only `also` is, white elsewhere."""
    image = np.full(mask.shape, 255, np.uint8)
    if also is not None:
        image[also] = 190
    image[mask] = 0
    return image


def _gray(soft: Soft) -> Gray:
    return np.rint(255.0 * (1.0 - soft)).astype(np.uint8)


def _cross(image: Gray, anchor: tuple[float, float] | None) -> Gray:
    drawn = image.copy()
    if anchor is not None:
        place = (round(anchor[0] - 0.5), round(anchor[1] - 0.5))
        cv2.drawMarker(drawn, place, 255, cv2.MARKER_CROSS, 40, 7)
        cv2.drawMarker(drawn, place, 0, cv2.MARKER_CROSS, 40, 3)
    return drawn
