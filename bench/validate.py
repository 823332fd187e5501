"""Validation beside a plain loop over scikit-image's SSIM, beside processes, and on one Dask worker and two.

Presses are of the simulated brush (loopback rig), photographed at 10 px/mm; throughput is of pictures with the size and
noise of the loopback camera's stills. Time and memory of the whole command by number of strokes: `bench growth`.
"""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.harness import BenchError, Result, interleave, machine
from bench.peak import measure
from bench.press_sessions import STILL, Presses, pressed, session
from brushloop.calibrate import pool as pools
from brushloop.calibrate.compare.place import (
    KEYS,
    SIZE_PX,
    Alignment,
    Field,
    Pixels,
    pack,
    simulated_pixels,
    unpack,
)
from brushloop.calibrate.compare.score import BEST_SHIFT_PX, csim, ssim
from brushloop.calibrate.validate.jobs import ABSENT, PrepareJob, ScoreJob, prepare_job, score_job
from brushloop.model.brush import Brush as Bundle
from brushloop.model.strokes import stroke_models
from brushloop.sessions.recording import Recording

STROKES = 60
FEW = 4
"""Memory is compared with that of this many times fewer strokes."""
SAME = 1e-6
START_S = 60.0


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Scores a second over 12 presses of one cell; strokes found on `n` photographs (60) by threads, and by Dask.

    ratio = ours over the plain loop, over processes; two workers over one. Raises BenchError where the scores differ
    by more than 1e-6 from scikit-image's, or a run fails.
    """
    strokes = STROKES if n is None else n
    if strokes < 1:
        raise ValueError(f"n = {n}: at least one stroke is needed")
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        place = session(under, "presses", Presses(strokes, seed, view=STILL))
        jobs = [PrepareJob(capture, None, Field()) for capture in Recording(place).captures()]
        few = session(under, "few", Presses(max(1, strokes // FEW), seed, view=STILL))
        return [*scoring(seed), *threads(jobs, seed), *cluster(under, jobs, seed), memory(few, place, seed)]


def memory(few: Path, many: Path, seed: int) -> Result:
    """Peak memory of the whole command, beside that on a few strokes."""
    out, strokes = many.parent / "report", Recording(many).strokes()
    level, used = (
        measure(
            sys.executable, "-m", "brushloop", "validate", str(place), "--no-held-out", "--out", f"{out}-{place.name}"
        )
        for place in (few, many)
    )
    where = (
        f"loopback rig, {strokes} stills of {STILL.width_px} x {STILL.height_px} px, {used.wall_s:.1f} s; {machine()}"
    )
    peer, ratio = f"1.05 times the peak at {Recording(few).strokes()}", 1.05 * level.peak_mb / used.peak_mb
    return Result("validate-memory", used.peak_mb, "MB", peer, ratio, strokes, seed, where)


def scoring(seed: int, repeats: int = 12, rounds: int = 3) -> list[Result]:
    """Presses scored against every model and against each other: compiled, and by a plain loop."""
    presses = [one for one in pressed((15.0, 5.0), repeats, seed) if not one.refused]
    models = stroke_models(Bundle())
    cell = presses[0].condition.depth_mm, presses[0].condition.tilt_deg
    predicted = tuple(pack(simulated_pixels(model, *cell, Field())) for model in models.values())
    pixels = tuple(press.pixels for press in presses)
    others = tuple(tuple(k for k in range(len(presses)) if k != m)[:9] for m in range(len(presses)))
    job = ScoreJob(pixels, predicted, pixels, others, (ABSENT,) * len(presses))
    found, plain = score_job(job), plain_scores(job)
    worst = float(np.nanmax(np.abs(found - plain)))
    if worst > SAME:
        raise BenchError(f"scores differ from scikit-image's by {worst:.1e}")
    turns = interleave(lambda: score_job(job), lambda: plain_scores(job), rounds)
    ours_s, peer_s = turns.median_s
    prepare_s = min(_seconds(lambda: pressed((15.0, 5.0), 1, seed)) for _ in range(rounds))
    where = (
        f"loopback rig, one thread; {len(models)} models and 9 other presses, both alignments and tones; worst "
        f"difference {worst:.1e}; simulating, photographing and finding a press takes {1e3 * prepare_s:.0f} ms; "
        f"{machine()}"
    )
    peer = "a plain loop over scikit-image's SSIM"
    rate = len(presses) / ours_s
    return [Result("validate.scored", rate, "strokes/s", peer, peer_s / ours_s, rounds, seed, where, **turns.ratios())]


def plain_scores(job: ScoreJob) -> NDArray[np.float64]:
    """The same numbers, one pair of images at a time."""
    out = np.full((len(job.presses), len(job.predictions) + 2, len(KEYS), 2), np.nan)
    predictions = [unpack(packed) for packed in job.predictions]
    others = [unpack(packed) for packed in job.others]
    for n, packed in enumerate(job.presses):
        captured = unpack(packed)
        for k, (alignment, _tone) in enumerate(KEYS):
            for m, images in enumerate(predictions):
                out[n, m, k] = plain_score(captured[k], images[k], alignment)
            predicted = [plain_score(captured[k], others[o][k], alignment) for o in job.predicted_by[n]]
            out[n, -2, k] = np.mean(predicted, axis=0)
    return out


def plain_score(captured: Pixels, predicted: Pixels, alignment: Alignment) -> tuple[float, float]:
    """CSIM and SSIM of two images, the second at its best shift where size and place do not count."""
    a, b = captured / 255.0, predicted / 255.0
    if alignment is Alignment.SIZE_NORMALISED:
        b = _shifted(b, a)
    return csim(a, b), ssim(a, b)


def _shifted(moving: NDArray[np.float64], fixed: NDArray[np.float64]) -> NDArray[np.float64]:
    """At the largest overlap, of equals at the least shift."""
    reach = BEST_SHIFT_PX
    padded = np.pad(moving, reach).astype(np.float32)
    overlap = cv2.matchTemplate(padded, fixed.astype(np.float32), cv2.TM_CCORR)
    top = float(overlap.max())
    # The correlation is rounded: whoever comes near the top is reckoned exactly.
    near = [(int(r), int(c)) for r, c in np.argwhere(overlap > top - 1e-3 * max(top, 1.0))]
    whole = np.rint(255 * np.pad(moving, reach)).astype(np.int64)
    target = np.rint(255 * fixed).astype(np.int64)
    sums = {(r, c): int((whole[r : r + SIZE_PX, c : c + SIZE_PX] * target).sum()) for r, c in near}
    best = max(sums.values())
    row, column = min(
        (at for at, value in sums.items() if value == best), key=lambda at: (at[0] - reach) ** 2 + (at[1] - reach) ** 2
    )
    return np.pad(moving, reach)[row : row + SIZE_PX, column : column + SIZE_PX]


def threads(jobs: Sequence[PrepareJob], seed: int) -> list[Result]:
    """Finding strokes on photographs by threads, beside as many processes that have already started."""
    with pools.threads() as pool, ProcessPoolExecutor(pool.workers, multiprocessing.get_context("spawn")) as processes:
        began = time.perf_counter()
        list(processes.map(prepare_job, jobs[: 4 * pool.workers]))
        start_s = time.perf_counter() - began
        named = [(str(k), job) for k, job in enumerate(jobs)]
        turns = interleave(
            lambda: list(pool.run(prepare_job, iter(named))), lambda: list(processes.map(prepare_job, jobs)), 3
        )
        workers = pool.workers
    ours_s, peer_s = turns.median_s
    size = f"{STILL.width_px} x {STILL.height_px} px"
    where = f"loopback rig, photographs of {size}, {workers} workers; starting the processes took {start_s:.1f} s"
    peer = "processes, already started"
    rate = len(jobs) / ours_s
    conditions = f"{where}; {machine()}"
    return [Result("validate.threads", rate, "strokes/s", peer, peer_s / ours_s, 3, seed, conditions, **turns.ratios())]


def cluster(under: Path, found: Sequence[PrepareJob], seed: int) -> list[Result]:
    """Finding strokes by one Dask worker and by two, each with one thread; nothing where Dask is missing."""
    if importlib.util.find_spec("distributed") is None:
        return []
    jobs = [(str(k), job) for k, job in enumerate(found)]
    taken: dict[int, float] = {}
    for workers in (1, 2):
        with _workers(under, workers) as address, pools.cluster(address) as pool:
            list(pool.run(prepare_job, iter(jobs[: 2 * workers])))  # imports, and what is compiled at the first call
            began = time.perf_counter()
            list(pool.run(prepare_job, iter(jobs)))
            taken[workers] = time.perf_counter() - began
    speed = taken[1] / taken[2]
    where = f"loopback rig, {len(jobs)} strokes, dask {version('distributed')}; {machine()}"
    rate = len(jobs) / taken[2]
    return [Result("validate.dask", rate, "strokes/s", "one worker; two here", speed, 1, seed, where)]


@contextmanager
def _workers(under: Path, count: int) -> Iterator[str]:
    """The address of a scheduler with this many workers of one thread."""
    scheduler_file = under / f"scheduler-{count}.json"
    here = ("--host", "127.0.0.1", "--no-dashboard")
    words = ("distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(scheduler_file), *here)
    started = [_quietly(under, *words)]
    try:
        deadline = time.monotonic() + START_S
        while not scheduler_file.is_file() or not scheduler_file.read_text():
            if time.monotonic() > deadline:
                raise BenchError("the Dask scheduler did not start")
            time.sleep(0.05)
        address = str(json.loads(scheduler_file.read_text())["address"])
        worker = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", *here)
        started += [_quietly(under, *worker) for _ in range(count)]
        distributed: Any = importlib.import_module("distributed")
        with distributed.Client(address, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=START_S)
        yield address
    finally:
        for process in reversed(started):
            process.kill()
            process.wait()


def _quietly(under: Path, *words: str) -> subprocess.Popen[bytes]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", *words]
    nowhere = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=under, env=environment, stdout=nowhere, stderr=nowhere)


def _seconds(work: Callable[[], object]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began
