"""Fit of a twin to the presses of a session: shape, intervals, spread, and scores on conditions left out; and its file.

`brushloop sim --brush twin.toml` presses with the file, and the command prints it. The camera's noise comes from stills
of one view: what differs between two of them where nothing was drawn.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from shlex import quote
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import FittedValue, made_by
from brushloop.calibrate.commands import TwinRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import Written, check_target, write_whole
from brushloop.calibrate.fit.heldout import BEZIER, Predicted, held_out_scores
from brushloop.calibrate.presses import read_for_fit
from brushloop.calibrate.report import source_note
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.stats import CEILING, NORMAL_95
from brushloop.calibrate.work import Store
from brushloop.drivers.sim.brush.brush_file import SoundHead
from brushloop.drivers.sim.brush.misfit import Misfit
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.model.presses import DepthTilt, Grid, Presses, image_of, refit_bezier
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Recording
from brushloop.sessions.terminal import Progress, unseen
from brushloop.twin.brush import HERE, SHAPE, SPREAD, STILL, Constant, Images, Vector, draw, place_at, with_values
from brushloop.twin.misfit import FIRST_SEED, VOTES, fit_misfit
from brushloop.twin.search import (
    FEWEST_REPEATS,
    FINE_MM,
    INDIVIDUAL,
    Searches,
    Spread,
    Target,
    covariance,
    fit_spread,
    of_parts,
)

MOST_WORKERS = 8
MOST_SD = 0.7
"""Standard error, in scales, above which the presses count as not determining a constant."""
WIDER = 3.5
"""Factor on the standard errors of mechanics and ink: constants that have nearly the same effect are known less well
than the derivatives at one point say. It was chosen on two brushes whose twins are not measured by the benches."""
PARTS = 3
TWIN, MECHANICS = "twin", "its mechanics alone"
OTHER_PHYSICS = 1.5
"""Points of CSIM below the ceiling from which the mechanics alone do not describe a brush: its constants of shape and
ink then imitate it and are no measurement, so that they have no intervals."""
PRESSES = 3
"""Presses of each condition."""
HEAD_SEED = 300
MARGIN_MM = 0.8
"""How far the head of a sound mark may lie from where it lay in these presses: the touch point is off by up to 0.5 mm,
and other presses differ."""
LEAST_MISPLACED_MM = 1.6
"""The limit of the quality checks by default: a smaller one is not needed."""
STILLS = 8
"""Stills that are compared, each with the next one."""
TO_SD = 1.4826
"""Standard deviation of normally distributed values over their median absolute deviation."""
JPEG_QUALITY = 95
PAPER_GRAY = 215
TRIED = np.arange(0.0, 12.1, 0.5)


def fitted_value(constant: Constant, scales: float, error: float) -> FittedValue:
    """A constant at a point of the search, with its standard error in scales.

    It has no interval where the presses do not determine it; the prior then does.
    """
    value, (least, most) = constant.value(scales), constant.bounds
    if error >= MOST_SD or not least + 0.01 < scales < most - 0.01:
        return FittedValue(value=value, low=None, high=None)
    low, high = (constant.value(scales + way * NORMAL_95 * error) for way in (-1.0, 1.0))
    return FittedValue(value=value, low=low, high=high)


@dataclass(frozen=True, slots=True)
class Twin:
    """A fitted twin, and all that is reported about it."""

    spec: BrushSpec
    values: dict[Constant, FittedValue]
    spread: Spread | None
    """None where no condition has enough captures; the spread is then the default brush's."""
    held_out: tuple[Stat, ...]
    """Empty where the conditions cannot be divided."""
    head: SoundHead | None = None
    """Where its marks begin; None if it leaves no ink."""
    misfit: Misfit | None = None
    """What its mechanics cannot express; None without ink."""


def twin(request: TwinRequest, progress: Progress = unseen) -> Written:
    """Fit a twin to the presses of a session, and write its file. Raises `CalibrationError`."""
    recording = Recording(request.session)
    target = request.out or recording.path.parent / "twin.toml"
    check_target(target, ".toml")
    if target.exists() and not request.replace:
        raise CalibrationError(str(target), "exists: give --out FILE or --replace")
    session, presses, refused = read_for_fit(request.session, progress)
    header = session.header
    with workers() as pool:
        try:
            fitted = fit_twin(presses.near_ink(), pool, progress, session.store)
        except ValueError as error:
            raise CalibrationError(str(recording.path), str(error)) from None
    lines = list(twin_toml(fitted, header.session_id, noise_gray(recording)))
    write_whole(target, "\n".join(lines) + "\n")
    said = [f"{source_note(header.source, header.brush)}; twin of {len(presses)} presses"]
    said += (f"left out: {name}: {why}" for name, why in refused)
    said += (*lines, f"Twin: {target}", f"next: brushloop sim --brush {quote(str(target))}")
    return Written(target, said, refused)


class TwinStopped(Exception):
    """A process that drew presses was ended from outside; the same command continues."""

    exit_code: ClassVar[int] = 4


@contextlib.contextmanager
def workers(most: int = MOST_WORKERS) -> Generator[Executor]:
    """Processes that draw presses, one for each core; they end with this one, even if it is killed.

    Raises `TwinStopped` if one of them ends before the block does, as when the system runs out of memory.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of matrix products would compete with the processes
    spawn = multiprocessing.get_context("spawn")
    processes = min(os.cpu_count() or 1, most)
    try:
        with ProcessPoolExecutor(processes, mp_context=spawn, initializer=_end_with_parent) as pool:
            yield pool
    except BrokenExecutor:
        raise TwinStopped("a drawing process was killed (too little memory?): repeat the command to continue") from None


def _end_with_parent() -> None:
    """Watch the process that started this one: a killed parent closes no pool."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def fit_twin(presses: Presses, pool: Executor, progress: Progress = unseen, store: Store | None = None) -> Twin:
    """Fit the twin of a brush to its presses. Passes of the search that the store holds are not repeated.

    Raises ValueError for a press that is deeper than a brush of this size allows.
    """
    grid, groups = presses.grid, {condition: presses.ink[numbers] for condition, numbers in presses.conditions.items()}
    means = np.asarray([ink.mean(axis=0) for ink in groups.values()], np.float32)
    size = BrushSpec(radius_mm=presses.radius_mm, length_mm=presses.length_mm, seed=INDIVIDUAL)
    target = Target(size, tuple(groups), grid, means)
    parts = parts_of(target.conditions)
    searches = Searches(pool, store, progress, 1 + len(parts))
    point = searches.coarse(target)
    repeats = {condition: ink for condition, ink in groups.items() if len(ink) >= FEWEST_REPEATS}
    spread: Spread | None = None
    if repeats:
        spread = fit_spread(target.brush(point), place_at(point), repeats, grid, pool)
        # hairs that stray make every mark wider and its ends fainter: the shape is fitted to the captures with them
        target = replace(target, base=with_values(target.base, SPREAD, spread.point))
    point = searches.descend(target, point, FINE_MM)
    variance = np.diagonal(covariance(target, point, pool))
    spec, place = target.brush(point), place_at(point)
    misfit = fit_misfit(spec, place, groups, grid)
    if spread is not None:
        spread = fit_spread(spec, place, repeats, grid, pool, spread.point, misfit)
    predicted, points = list[Predicted](), list[Vector]()
    for part in parts:
        others = target.only([k for k in range(len(groups)) if k not in part])
        without = searches.descend(others, searches.coarse(others), FINE_MM)
        points.append(without)
        predicted += _predicted(presses, [target.conditions[k] for k in part], without, target)
    held_out = tuple(held_out_scores(predicted, (TWIN, MECHANICS, BEZIER)))
    errors = WIDER * np.sqrt(variance + of_parts(points))
    if mechanics_below(held_out) > OTHER_PHYSICS:
        errors = np.full_like(errors, np.inf)
    found = [*zip(SHAPE, point, errors, strict=False)]
    if spread is not None:
        spec = with_values(spec, SPREAD, spread.point)
        found += [*zip(SPREAD, spread.point, spread.error, strict=True)]
    values = {constant: fitted_value(constant, scales, error) for constant, scales, error in found}
    return Twin(spec, values, spread, held_out, sound_head(spec, target.conditions, grid, misfit), misfit)


def _predicted(presses: Presses, held: list[DepthTilt], there: Vector, target: Target) -> Iterator[Predicted]:
    """Yield the conditions `held` as predicted by the twin without them, and by a Bezier refitted to the others.

    The mean of marks that wander is shorter than the mean mark, so presses are predicted by a brush that does not.
    """
    conditions = presses.conditions
    others = {condition: numbers for condition, numbers in conditions.items() if condition not in held}
    brush, place = replace(target.brush(there), **STILL), place_at(there)
    misfit = fit_misfit(brush, place, {at: presses.ink[numbers] for at, numbers in others.items()}, target.grid)
    bent, plain = (draw(brush, place, held, target.grid, VOTES, FIRST_SEED, one).mean(axis=1) for one in (misfit, None))
    bezier = refit_bezier(presses.pick([k for numbers in others.values() for k in numbers]))
    for condition, image, alone in zip(held, bent, plain, strict=True):
        images: dict[str, NDArray[np.floating]] = {TWIN: image, MECHANICS: alone}
        if bezier is not None:
            images[BEZIER] = image_of(bezier(*condition), target.grid)
        yield presses.ink[conditions[condition]], images


def mechanics_below(held_out: Sequence[Stat]) -> float:
    """Points of CSIM by which the mechanics alone lie below the ceiling in conditions left out; 0 if not known."""
    csim = {row.model: row.csim.avg for row in held_out}
    return csim[CEILING] - csim[MECHANICS] if {CEILING, MECHANICS} <= csim.keys() else 0.0


def parts_of(conditions: Sequence[DepthTilt]) -> list[list[int]]:
    """Numbers of the conditions in each part, along the diagonals of the grid of depths and tilts."""
    depths, tilts = sorted({depth for depth, _ in conditions}), sorted({tilt for _, tilt in conditions})
    diagonal = [(depths.index(depth) + tilts.index(tilt)) % PARTS for depth, tilt in conditions]
    parts = [[k for k, at in enumerate(diagonal) if at == part] for part in range(PARTS)]
    return [part for part in parts if part and len(part) < len(conditions)]


def sound_head(
    spec: BrushSpec, conditions: Sequence[DepthTilt], grid: Grid, misfit: Misfit | None = None
) -> SoundHead | None:
    """The settings of the quality checks with which presses of the twin in these conditions pass; None without ink."""
    drawn = draw(spec, HERE, conditions, grid, PRESSES, HEAD_SEED, misfit)
    heads_mm = [at for images in drawn for image in images if (at := _head_mm(image, grid)) is not None]
    if not heads_mm:
        return None
    middle_mm = 0.5 * (min(heads_mm) + max(heads_mm))
    reach_mm = max(max(heads_mm) - middle_mm + MARGIN_MM, LEAST_MISPLACED_MM)
    return SoundHead(head_mm=round(middle_mm, 1), misplaced_mm=round(reach_mm, 1))


def _head_mm(image: Images, grid: Grid) -> float | None:
    """Where the mark begins along +x: its end near the point of touch, away from its tip."""
    columns = np.flatnonzero((image > 0.5).any(axis=0))
    if not columns.size:
        return None
    left, right = grid.x_mm[columns[0]] - 0.5 * grid.px_mm, grid.x_mm[columns[-1]] + 0.5 * grid.px_mm
    return float(-left if abs(left) < abs(right) else right)


def twin_toml(twin: Twin, session_id: str, noise_gray: float | None) -> Iterator[str]:
    """Yield the lines of `twin.toml`: every constant of the brush, and what is known of it as a comment.

    `noise_gray` is that of the camera, None where it was not measured.
    """
    plain = "".join(char if char.isprintable() and char not in '"\\' else "?" for char in session_id)
    yield f"# Made by `brushloop twin` ({made_by()}); press with it: brushloop sim --brush FILE."
    yield "# Everything that this brush presses is simulated. Intervals cover about 95 %: see docs/loopback-brush.md."
    yield f'name = "simulated bristle bundle (twin of {plain[:60]}, simulated)"'
    if noise_gray is None:
        yield "# The camera's noise was not measured: no two stills show the same view."
    else:
        yield from ("", "[camera]", f"noise = {noise_gray:.2f}    # gray levels, from pairs of stills")
    if twin.head is not None:
        yield from ("", "[quality]")
        yield f"head_mm = {twin.head.head_mm:g}    # how far behind the point of touch marks begin: middle of the range"
        yield f"misplaced_mm = {twin.head.misplaced_mm:g}    # half the range of where marks begin, with a margin"
    yield from ("", "[brush]")
    yield f"radius_mm = {twin.spec.radius_mm:g}    # as recorded with the session"
    yield f"length_mm = {twin.spec.length_mm:g}    # as recorded with the session"
    yield f"seed = {twin.spec.seed}    # of the hairs, which are not fitted"
    for constant, fitted in twin.values.items():
        known = "not determined by these presses" if fitted.low is None else f"{fitted.low:.4g} to {fitted.high:.4g}"
        unit = f"{constant.unit}; " if constant.unit else ""
        yield f"{constant.name} = {fitted.value:.6g}    # {unit}{known}; default {constant.default:.4g}"
    if (points := mechanics_below(twin.held_out)) > OTHER_PHYSICS:
        short = f"its mechanics alone lie {points:.1f} points of CSIM below the ceiling"
        yield f"# The brush obeys other physics ({short}): constants of shape and ink are no measurement."
    for row in twin.held_out:
        scores = f"CSIM {row.csim.avg:.2f} %, SSIM {row.ssim.avg:.2f} %, n = {row.csim.n}"
        yield f"# a third of the conditions left out in turn: {row.model}: {scores}"
    if twin.spread is None:
        yield "# No condition has three captures, so presses differ as those of the default brush do."
    else:
        yield (
            f"# two presses of a condition: CSIM {twin.spread.captured_percent:.2f} % captured, "
            f"{twin.spread.twin_percent:.2f} % from the twin"
        )
    if twin.misfit is not None:
        yield from ("", "[misfit]    # what the mechanics cannot express: see docs/loopback-brush.md")
        yield from (f"{name} = {json.dumps(value)}" for name, value in twin.misfit.model_dump(mode="json").items())


def noise_gray(recording: Recording) -> float | None:
    """The noise of a session's camera in gray levels, from its first stills; None for imports, or a single still.

    An import may hold one picture from each of several views.
    """
    if recording.header.source.imported:
        return None
    stills: list[NDArray[np.uint8]] = []
    for capture in recording.captures():
        with contextlib.suppress(SessionDamaged):
            stills.append(capture.image())
        if len(stills) == STILLS:
            break
    return noise_of(stills)


def noise_of(stills: Sequence[NDArray[np.uint8]]) -> float | None:
    """Standard deviation in gray levels that the simulated camera needs to be as noisy; None if no two show one view.

    Each pixel's difference between two stills (h, w) has the noise of both; places where ink was added are left out.
    The simulated camera compresses its pictures, which takes away part of the noise: the value is the one that leaves
    as much after compression.
    """
    apart = [_difference(a, b) for a, b in pairwise(stills) if a.shape == b.shape]
    return float(np.interp(np.median(apart), [_left_after_jpeg(sd) for sd in TRIED], TRIED)) if apart else None


def _difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    moved = a.astype(np.float32) - b.astype(np.float32)
    # a median of whole gray levels is coarse: the mean of what lies within a few levels is not
    near = moved[np.abs(moved) <= max(4.0 * TO_SD * float(np.median(np.abs(moved))), 4.0)]
    return float(near.std()) / np.sqrt(2.0)


def _left_after_jpeg(sd: float) -> float:
    rng = np.random.default_rng(0)
    flat = np.clip(PAPER_GRAY + rng.normal(0.0, sd, (128, 128)), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return float(np.std(np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.float64)))
