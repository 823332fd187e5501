"""Fit of a twin to the presses of a session: shape, intervals, spread, and scores on cells left out."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from brushloop.calibrate.fit.captures import Grid, Pressed, by_cell
from brushloop.calibrate.fit.heldout import (
    BEZIER,
    HeldOut,
    Scores,
    image_of,
    refit_bezier,
)
from brushloop.calibrate.stats import CEILING
from brushloop.drivers.sim.brush.spec import BrushSpec
from brushloop.drivers.sim.config import SoundHead
from brushloop.sessions.terminal import Progress, unseen
from brushloop.twin.constants import SHAPE, SPREAD, Constant, Offset, Vector, brush_at, offset_at, with_values
from brushloop.twin.drawing import Cell, Images, draw
from brushloop.twin.shape import (
    COARSE,
    FINE,
    Found,
    Round,
    Target,
    choose_individual,
    covariance,
    of_parts,
    search,
    start,
)
from brushloop.twin.spread import FEWEST_REPEATS, Repeats, Spread, fit_spread

MOST_WORKERS = 8
MOST_SD = 0.7
"""Standard error, in scales, above which the presses count as not determining a constant."""
NORMAL_95 = 1.96
WIDER = 3.5
"""Factor on the standard errors of mechanics and ink: constants that have nearly the same effect are known less well
than the derivatives at one point say. It was chosen on two brushes of `DEVELOPMENT` in `bench/brushes.py`."""
Keep = Callable[[str, Found], None]
"""Called after each step with its name and the point that the search has reached."""
PARTS = 3
TWIN = "twin"
VOTES = 7
"""Presses of the twin that are averaged to one prediction."""
FIRST_SEED = 900
PRESSES = 3
"""Presses of each cell."""
HEAD_SEED = 300
MARGIN_MM = 0.8
"""How far the head of a sound mark may lie from where it lay in these presses: the touch point is off by up to 0.5 mm,
and other presses differ."""
LEAST_MISPLACED_MM = 1.6
"""The limit of the quality checks by default: a smaller one is not needed."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """A constant of the twin with its 95 % interval."""

    constant: Constant
    value: float
    low: float
    high: float
    determined: bool
    """False where the presses do not determine it; the prior then does."""


@dataclass(frozen=True, slots=True)
class Twin:
    """A fitted twin, and all that is reported about it."""

    spec: BrushSpec
    estimates: tuple[Estimate, ...]
    spread: Spread | None
    """None where no cell has enough captures; the spread is then the default brush's."""
    held_out: tuple[HeldOut, ...]
    """Empty where the cells cannot be divided."""
    head: SoundHead | None = None
    """Where its marks begin; None if it leaves no ink."""


class TwinStopped(Exception):
    """A process that drew presses was ended from outside; the same command continues."""

    exit_code: ClassVar[int] = 4


@contextlib.contextmanager
def workers(most: int = MOST_WORKERS) -> Generator[Executor]:
    """Processes that draw presses, one for each core; they end with this one, even if it is killed.

    Raises `TwinStopped` on SIGTERM, once what is being drawn is drawn, and if one of them ends before the block does,
    as when the system runs out of memory.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads of matrix products would compete with the processes
    count = min(os.cpu_count() or 1, most)
    spawn = multiprocessing.get_context("spawn")

    def terminated(_number: int, _frame: object) -> None:
        raise TwinStopped("SIGTERM: the same command continues")

    before = signal.signal(signal.SIGTERM, terminated)  # a process that just ends leaks the pool's semaphores
    pool = ProcessPoolExecutor(count, mp_context=spawn, initializer=_end_with_parent)
    try:
        yield pool
    except BrokenExecutor:
        raise TwinStopped("a process that drew presses was ended (memory?): the same command continues") from None
    finally:
        pool.shutdown(cancel_futures=True)
        signal.signal(signal.SIGTERM, before)


def _end_with_parent() -> None:
    """Watch the process that started this one: a killed parent closes no pool."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="parent", daemon=True).start()


def fit_twin(
    strokes: Sequence[Pressed],
    grid: Grid,
    radius_mm: float,
    length_mm: float,
    pool: Executor,
    progress: Progress = unseen,
    before: dict[str, Found] | None = None,
    keep: Keep = lambda _name, _found: None,
) -> Twin:
    """Fit the twin of a brush of this size to its presses.

    `before` holds the finished steps of an interrupted run; `keep` is called with each new one.
    Raises ValueError for a press that is deeper than a brush of this size allows.
    """
    cells = by_cell(strokes)
    target = target_of(cells, radius_mm, length_mm, grid)
    parts = parts_of(target.cells)
    ticks = _Ticks(progress, (1 + len(parts)) * sum(one.steps for one in (*COARSE, FINE)))
    run = _Run(pool, ticks, before or {}, keep)
    found = run.coarse("all cells", target)
    repeats, spread = repeats_of(cells), None
    if repeats.cells:
        spread = fit_spread(_brush(found, target), offset_at(found.point), repeats, grid, pool.map)
        # hairs that stray make every mark wider and its ends fainter: the shape is fitted to the captures with them
        target = replace(target, base=with_values(target.base, SPREAD, spread.point))
    found = run.fine("all cells", target, found)
    variance = np.diagonal(covariance(target, found, pool))
    spec, offset = _brush(found, target), offset_at(found.point)
    if spread is not None:
        spread = fit_spread(spec, offset, repeats, grid, pool.map, spread.point)
    scores, points = Scores(), list[Vector]()
    for number, part in enumerate(parts, 1):
        kept = [k for k in range(len(cells)) if k not in part]
        name, others = f"part {number} left out", target.only(kept)
        there = run.fine(name, others, run.coarse(name, others))
        points.append(there.point)
        _score_part(scores, cells, [target.cells[k] for k in part], there, target)
    ticks.end()
    errors = WIDER * np.sqrt(variance + of_parts(points))
    estimates = [_estimate(*one) for one in zip(SHAPE, found.point, errors, strict=False)]
    if spread is not None:
        spec = with_values(spec, SPREAD, spread.point)
        estimates += [_estimate(*one) for one in zip(SPREAD, spread.point, spread.error, strict=True)]
    held_out = tuple(scores.rows((CEILING, TWIN, BEZIER)))
    return Twin(spec, tuple(estimates), spread, held_out, sound_head(spec, target.cells, grid))


def _score_part(
    scores: Scores,
    cells: dict[Cell, list[Pressed]],
    held: list[Cell],
    there: Found,
    target: Target,
) -> None:
    """Score the cells `held` by the twin found without them, and by a Bezier refitted to the others."""
    drawn = predicted(_brush(there, target), offset_at(there.point), held, target.grid)
    others = [one for cell, group in cells.items() if cell not in held for one in group]
    bezier = None
    with contextlib.suppress(ValueError):  # the other cells are too few to fit a plane
        bezier = refit_bezier(others, target.grid)
    for cell in held:
        images: dict[str, Images] = {TWIN: drawn[cell]}
        if bezier is not None:
            images[BEZIER] = image_of(bezier.outline(*cell), target.grid)
        scores.add(cells[cell], images)


def _brush(found: Found, target: Target) -> BrushSpec:
    return brush_at(found.point, replace(target.base, seed=found.seed))


def target_of(cells: dict[Cell, list[Pressed]], radius_mm: float, length_mm: float, grid: Grid) -> Target:
    """The mean capture of each cell."""
    means = [np.mean([one.ink for one in group], axis=0) for group in cells.values()]
    base = BrushSpec(radius_mm=radius_mm, length_mm=length_mm, seed=0)
    return Target(base, tuple(cells), grid, np.asarray(means, np.float32))


def repeats_of(cells: dict[Cell, list[Pressed]]) -> Repeats:
    """The captures of the cells that have at least `FEWEST_REPEATS`."""
    several = {cell: group for cell, group in cells.items() if len(group) >= FEWEST_REPEATS}
    return Repeats(tuple(several), tuple(np.array([one.ink for one in group]) for group in several.values()))


class _Ticks:
    """Progress over all passes; a pass that ends early counts as if it had taken all its steps."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress = progress
        self._total = total
        self._done = 0
        self._due = 0
        progress("twin: steps of the search", 0, total)

    def tick(self) -> None:
        self._show(min(self._done + 1, self._total))

    def passed(self, steps: int) -> None:
        """A pass of this many steps has ended."""
        self._due += steps
        self._show(max(self._done, self._due))

    def _show(self, done: int) -> None:
        self._done = done
        self._progress("twin: steps of the search", done, self._total)

    def end(self) -> None:
        self.passed(self._total - self._due)


class _Run:
    """The searches of one twin; those that an interrupted run finished are not repeated."""

    def __init__(self, pool: Executor, ticks: _Ticks, before: dict[str, Found], keep: Keep) -> None:
        self._pool = pool
        self._ticks = ticks
        self._before = before
        self._keep = keep

    def coarse(self, what: str, target: Target) -> Found:
        found = self._individual(f"{what}, first individual", target, start())
        for one in COARSE:
            found = self._step(f"{what}, blur {one.blur_mm:g} mm", one, target, found)
        return found

    def fine(self, what: str, target: Target, found: Found) -> Found:
        found = self._individual(f"{what}, individual", target, found)
        return self._step(f"{what}, blur {FINE.blur_mm:g} mm", FINE, target, found)

    def _individual(self, name: str, target: Target, found: Found) -> Found:
        return self._known(name, lambda: choose_individual(target, found, self._pool))

    def _step(self, name: str, one: Round, target: Target, found: Found) -> Found:
        ended = self._known(name, lambda: search(target, found, one, self._pool, self._ticks.tick))
        self._ticks.passed(one.steps)
        return ended

    def _known(self, name: str, work: Callable[[], Found]) -> Found:
        if name in self._before:
            return self._before[name]
        found = work()
        self._keep(name, found)
        return found


def _estimate(constant: Constant, scales: float, error: float) -> Estimate:
    ends = (constant.value(scales + way * NORMAL_95 * error) for way in (-1.0, 1.0))
    low, high = constant.bounds
    inside = low + 0.01 < scales < high - 0.01
    return Estimate(constant, constant.value(scales), *ends, determined=bool(error < MOST_SD and inside))


def parts_of(cells: Sequence[Cell]) -> list[list[int]]:
    """Numbers of the cells in each part, along the diagonals of the grid of depths and tilts."""
    heights, tilts = sorted({h for h, _ in cells}), sorted({a for _, a in cells})
    diagonal = [(heights.index(h) + tilts.index(a)) % PARTS for h, a in cells]
    parts = [[k for k, at in enumerate(diagonal) if at == part] for part in range(PARTS)]
    return [part for part in parts if part and len(part) < len(cells)]


def predicted(spec: BrushSpec, offset: Offset, cells: Sequence[Cell], grid: Grid) -> dict[Cell, Images]:
    """Mean ink of several presses of the twin in each cell."""
    drawn = draw(spec, offset, cells, grid, VOTES, FIRST_SEED)
    return dict(zip(cells, drawn.mean(axis=1), strict=True))


def sound_head(spec: BrushSpec, cells: Sequence[Cell], grid: Grid) -> SoundHead | None:
    """The settings of the quality checks with which presses of the twin in these cells pass; None without ink."""
    drawn = draw(spec, Offset(0.0, 0.0, 0.0), cells, grid, PRESSES, HEAD_SEED)
    heads_mm = [at for cell in drawn for image in cell if (at := _head_mm(image, grid)) is not None]
    if not heads_mm:
        return None
    middle_mm = 0.5 * (min(heads_mm) + max(heads_mm))
    reach_mm = max(heads_mm) - middle_mm
    return SoundHead(round(middle_mm, 1), round(max(reach_mm + MARGIN_MM, LEAST_MISPLACED_MM), 1))


def _head_mm(image: Images, grid: Grid) -> float | None:
    """Where the mark begins along +x: its end near the point of touch, away from its tip."""
    columns = np.flatnonzero((image > 0.5).any(axis=0))
    if not columns.size:
        return None
    left, right = grid.x_mm[columns[0]] - 0.5 * grid.px_mm, grid.x_mm[columns[-1]] + 0.5 * grid.px_mm
    return float(-left if abs(left) < abs(right) else right)
