"""What comes before scoring: every capture found and laid on pixels, and fits to other cells. Finished work is kept."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from calibrate.compare.field import Field
from calibrate.compare.simulate import brush_of
from calibrate.validate.heldout import MOST_FOLDS, MOST_STROKES, PER_CELL, Cell, RefitJob, folds, refit_job, start_of
from calibrate.validate.jobs import VERSION, PrepareJob, Press, prepare_job, press_of
from calibrate.validate.pool import Scheduler
from calibrate.validate.sources import Opened
from calibrate.validate.store import Store

Progress = Callable[[str, int, int], None]
"""What is being done, how much of it is done, of how much."""


@dataclass(frozen=True, slots=True)
class Row:
    """A captured stroke without its pixels; `key` finds them in the store."""

    session: int
    number: int
    press: Press
    key: str

    @property
    def cell(self) -> Cell:
        """(H, alpha) as commanded."""
        return self.press.height_mm, self.press.tilt_deg


def prepared_rows(
    number: int, session: Opened, view: Field, scheduler: Scheduler, store: Store, progress: Progress
) -> Iterator[Row]:
    """Every stroke of a session, in order of capture; what is not in the store yet is prepared first."""
    calibration = session.calibration.digest if session.calibration is not None else ""
    bad = sorted(session.recording.marked_bad().items())
    base = hashlib.sha256(f"prepare {VERSION} {session.sha256} {calibration} {view} {bad}".encode()).hexdigest()
    keys = [f"{base}:{k}" for k in range(session.count)]
    what = f"{session.header.session_id}: found"
    missing = [key for key in keys if key not in store]
    done = len(keys) - len(missing)
    if missing:
        waiting = set(missing)

        def jobs() -> Iterator[tuple[str, PrepareJob]]:
            for key, capture in zip(keys, session.recording.captures(), strict=True):
                if key in waiting:
                    yield key, PrepareJob(capture, session.calibration, view)

        for key, press in scheduler.run(prepare_job, jobs()):
            store.put(key, press.to_body())
            done += 1
            progress(what, done, len(keys))
    for k, key in enumerate(keys):
        body = store.get(key)
        yield Row(number, k, press_of(body | {"pixels": b""}), key)


def refits_by_cell(
    session: Opened,
    rows: Sequence[Row],
    view: Field,
    scheduler: Scheduler,
    store: Store,
    progress: Progress,
    most_folds: int = MOST_FOLDS,
) -> dict[Cell, dict[str, Any]]:
    """A finished refit for each cell, made of whole presses of other cells."""
    cells: dict[Cell, list[Row]] = {}
    for row in rows:
        cells.setdefault(row.cell, []).append(row)
    brush = brush_of(session.header)
    start = start_of(session.fit) if session.fit is not None else None
    made: dict[Cell, dict[str, Any]] = {}
    left = folds(list(cells), most_folds)
    done = 0
    jobs: list[tuple[str, RefitJob]] = []
    of_key: dict[str, list[Cell]] = {}
    for fold in left:
        others = [row for cell, group in sorted(cells.items()) if cell not in fold for row in _whole(group)[:PER_CELL]]
        others = others[:: max(1, -(-len(others) // MOST_STROKES))]
        if not others:
            continue
        strokes = tuple((*row.cell, pixels_of(store, row.key)) for row in others)
        job = RefitJob(strokes, float(brush.radius_mm), float(brush.length_mm), start, view)
        of_key[job.key] = fold
        if job.key not in store:
            jobs.append((job.key, job))
    done = len(of_key) - len(jobs)
    for key, found in scheduler.run(refit_job, iter(jobs)):
        store.put(key, found)
        done += 1
        progress(f"{session.header.session_id}: cells left out in turn", done, len(of_key))
    for key, fold in of_key.items():
        made |= dict.fromkeys(fold, store.get(key))
    return made


def _whole(group: list[Row]) -> list[Row]:
    return [row for row in group if not row.press.cut]


def pixels_of(store: Store, key: str) -> bytes:
    """`Press.pixels` of a stroke that was prepared."""
    return store.get(key)["pixels"]
