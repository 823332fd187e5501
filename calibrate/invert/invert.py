"""Depth and tilt of presses, recovered from their coverage of the millimetre field, each with its interval.

The recovered (H, alpha) is the press for which this model makes this mark. It measures the actual press only as well as
the model describes the brush: where commands are known, the model's error is told from them and added.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.presses import Press, Refused
from brushloop.calibrate.stats import student_95
from brushloop.model.inversion import Flag, Inverter

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
DepthTilt = tuple[float, float]
"""Depth in mm and tilt in deg."""
LEAST_CELLS = 3
"""With fewer other conditions, the model error is unknown."""
NORMAL_95 = 1.96
ROUNDS = 100


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


def invert_presses(presses: Iterable[Press], inverter: Inverter, refused: list[Refused]) -> list[Row]:
    """Recover presses in batches, by the image alone; those that cannot be recovered go to `refused`."""
    rows: dict[str, Row] = {}
    remaining = iter(presses)
    while batch := list(islice(remaining, BATCH)):
        images = np.stack([press.coverage for press in batch])
        places = np.array([press.anchor_mm for press in batch])
        recovered = inverter(images, places, np.array([press.stroke.heading_deg for press in batch]))
        for k, press in enumerate(batch):
            stroke, flags = press.stroke, recovered.flags[k]
            useless = ", ".join(sorted(flags & USELESS))
            if problem := useless or _unnameable(stroke.stroke_id, rows):
                refused.append((stroke.stroke_id, problem))
                continue
            (depth_mm, tilt_deg), (depth_sd_mm, tilt_sd_deg) = recovered.values[k, :2], recovered.sigma[k, :2]
            rows[stroke.stroke_id] = Row(
                stroke.stroke_id,
                float(depth_mm),
                float(tilt_deg),
                float(depth_sd_mm),
                float(tilt_sd_deg),
                float(recovered.rms[k]),
                tuple(sorted(flags)),
                stroke.depth_mm,
                stroke.tilt_deg,
            )
    return list(rows.values())


def with_model_error(rows: Sequence[Row], fitted: Collection[DepthTilt] = ()) -> list[Row]:
    """The rows with the model error added to their standard deviations, and flags for unknown or wide intervals.

    `fitted` are the conditions that the model was fitted to.
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


def _unnameable(ident: str, taken: Collection[str]) -> str:
    """Reason why a protocol cannot press a stroke of this name again; empty if it can."""
    if ident in taken:
        return "its name is that of another stroke too"
    if not 1 <= len(ident) <= 100 or not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident):
        return "its name cannot stand in a protocol"
    return "its name cannot stand in a protocol" if ident[0] in ".-~" else ""


def off_command(rows: list[Row]) -> Iterator[tuple[str, float, float | None, float, int]]:
    """Yield (parameter, mean of recovered - commanded, standard deviation, share in the 95 % interval, n).

    A single press has no standard deviation: None.
    """
    pairs = {
        "H": [(r.depth_mm, r.depth_sd_mm, r.commanded_depth_mm) for r in rows],
        "alpha": [(r.tilt_deg, r.tilt_sd_deg, r.commanded_tilt_deg) for r in rows],
    }
    for name, values in pairs.items():
        known = [(value - asked, sd) for value, sd, asked in values if asked is not None]
        if known:
            off, sd = (np.array(part, np.float64) for part in zip(*known, strict=True))
            inside = np.abs(off) <= NORMAL_95 * sd
            scatter = float(off.std(ddof=1)) if len(off) > 1 else None
            yield name, float(off.mean()), scatter, float(inside.mean()), len(off)


def model_sd(off: Floats, sd: Floats, cells: list[DepthTilt], fitted: Collection[DepthTilt] = ()) -> Floats:
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
