"""Intrinsics of a camera from photographs of a board: what each photograph contributes, and which do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from calibrate.camera.boards import View
from calibrate.camera.lens import Floats, Lens
from calibrate.errors import CalibrationError

LEAST_VIEWS = 4
GOOD_VIEWS = 10
OUTLIER_MEDIANS = 3.0
"""A view whose residual is so many times the median's is dropped and named."""
LEAST_OUTLIER_PX = 0.4
RMS_LIMIT_PX = 0.5
"""Above this a pre-flight check warns: a flat, sharp, still board gives 0.1 to 0.3 px."""
GRID = (3, 3)
"""Coverage is judged on so many columns and rows of the image."""
GRID_WORDS = (
    ("upper left", "upper middle", "upper right"),
    ("left", "middle", "right"),
    ("lower left", "lower middle", "lower right"),
)
LEAST_SLANT_DEG = 15.0
"""Boards face on tell focal length and distance together only."""


@dataclass(frozen=True, slots=True)
class Fitted:
    """A lens, how sure it is, and view by view how well it explains the photographs."""

    lens: Lens
    focal_se_px: tuple[float, float]
    """Standard errors of fx and fy."""
    rms_px: float
    """Over all corners of the views that were kept."""
    residuals_px: dict[str, float]
    """Of each kept view by name."""
    dropped: dict[str, float]
    """Views left out as outliers, with the residual that told so."""
    slants_deg: dict[str, float]
    """How far each kept board is turned from face on."""
    guidance: tuple[str, ...]
    """What to photograph besides; empty where the coverage is good."""
    warnings: tuple[str, ...]
    """What a pre-flight check must show."""


def fit_lens(views: Sequence[View], rms_limit_px: float = RMS_LIMIT_PX) -> Fitted:
    """Zhang's method by cv2.calibrateCamera (k1, k2, p1, p2, k3) over the views that fit together.

    Raises `CalibrationError` for fewer than `LEAST_VIEWS` views, or views of several sizes.
    """
    where = f"{len(views)} photographs"
    if len({view.size_px for view in views}) > 1:
        sizes = ", ".join(f"{w} x {h}" for w, h in sorted({view.size_px for view in views}))
        raise CalibrationError(where, f"have several sizes ({sizes} px): a lens is calibrated for one")
    kept, dropped = list(views), dict[str, float]()
    while True:
        if len(kept) < LEAST_VIEWS:
            out = f", dropped: {', '.join(sorted(dropped))}" if dropped else ""
            raise CalibrationError(where, f"{len(kept)} usable views of the board, at least {LEAST_VIEWS} needed{out}")
        rms_px, matrix, distortion, turns, errors, residuals = _calibrate(kept, where)
        worst = int(np.argmax(residuals))
        # The median of the others: with four views one bad one would hide behind itself.
        others = float(np.median(np.delete(residuals, worst)))
        if residuals[worst] <= max(LEAST_OUTLIER_PX, OUTLIER_MEDIANS * others):
            break
        dropped[kept[worst].name] = float(residuals[worst])
        del kept[worst]
    lens = Lens(matrix, distortion, views[0].size_px)
    slants = {view.name: _slant_deg(turn) for view, turn in zip(kept, turns, strict=True)}
    warnings = [f"{view.name}: {flag}" for view in kept for flag in view.flags]
    if rms_px > rms_limit_px:
        warnings.insert(0, f"residual {rms_px:.2f} px exceeds {rms_limit_px:g} px: is the board flat, sharp and still?")
    return Fitted(
        lens,
        (float(errors[0]), float(errors[1])),
        rms_px,
        {view.name: float(r) for view, r in zip(kept, residuals, strict=True)},
        dropped,
        slants,
        guidance(kept, list(slants.values())),
        tuple(warnings),
    )


def guidance(views: Sequence[View], slants_deg: Sequence[float]) -> tuple[str, ...]:
    """What is missing in these views, as instructions."""
    wanted: list[str] = []
    if len(views) < GOOD_VIEWS:
        wanted.append(f"take {GOOD_VIEWS - len(views)} more photographs ({len(views)} used, {GOOD_VIEWS} are good)")
    width, height = views[0].size_px
    places = np.concatenate([view.pixels for view in views])
    counts, _, _ = np.histogram2d(places[:, 1], places[:, 0], bins=(GRID[1], GRID[0]), range=((0, height), (0, width)))
    empty = [GRID_WORDS[r][c] for r in range(GRID[1]) for c in range(GRID[0]) if counts[r, c] == 0]
    if empty:
        wanted.append(f"bring the board into the {', '.join(empty)} of the image: no corner was seen there")
    slanted = sum(slant >= LEAST_SLANT_DEG for slant in slants_deg)
    if slanted < min(4, LEAST_VIEWS):
        wanted.append(
            f"slant the board by {LEAST_SLANT_DEG:.0f} to 45 deg in at least 4 photographs ({slanted} so far)"
        )
    return tuple(wanted)


def _calibrate(views: Sequence[View], where: str) -> tuple[float, Floats, Floats, list[Floats], Floats, Floats]:
    objects = [np.column_stack([v.board_mm, np.zeros(len(v.board_mm))]).astype(np.float32) for v in views]
    pixels = [v.pixels.astype(np.float32).reshape(-1, 1, 2) for v in views]
    none = np.zeros((3, 3))
    try:
        rms, matrix, distortion, turns, _, errors, _, per_view = cv2.calibrateCameraExtended(
            objects, pixels, views[0].size_px, none, np.zeros(5)
        )
    except cv2.error as error:
        raise CalibrationError(where, f"no lens explains these views: {error.err}") from None
    return (
        float(rms),
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).ravel()[:5],
        [np.asarray(turn, np.float64) for turn in turns],
        np.asarray(errors, np.float64).ravel(),
        np.asarray(per_view, np.float64).ravel(),
    )


def _slant_deg(turn: Floats) -> float:
    matrix, _ = cv2.Rodrigues(turn)
    return float(np.degrees(np.arccos(np.clip(abs(matrix[2, 2]), 0.0, 1.0))))
