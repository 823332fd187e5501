"""Where jobs run: threads of this machine, or a Dask cluster. Both give the same results, in no fixed order.

Threads, not processes: the work is OpenCV and compiled loops, which let other threads run, and a thread starts at once,
while a process first spends seconds on imports.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypeVar

from brushloop.calibrate.errors import CalibrationError, one_line
from brushloop.calibrate.store import VERSION, Arrays, Store

J = TypeVar("J")
R = TypeVar("R")
AHEAD = 2
"""Jobs submitted per worker; more would only hold photographs in memory."""
CONNECT_S = 10.0


@dataclass(frozen=True, slots=True)
class Scheduler:
    """Runs a function over named jobs."""

    executor: Executor
    workers: int
    """Number of jobs that run at a time."""

    def run(self, function: Callable[[J], R], jobs: Iterator[tuple[str, J]]) -> Iterator[tuple[str, R]]:
        """Yield (name, result) as jobs finish. A job is taken from the iterator only when there is room for it."""
        running: dict[Future[R], str] = {}
        try:
            for name, job in jobs:
                running[self.executor.submit(_alone, function, job)] = name
                while len(running) >= AHEAD * self.workers:
                    yield from _finished(running)
            while running:
                yield from _finished(running)
        finally:
            for future in running:
                future.cancel()


def _finished(running: dict[Future[R], str]) -> Iterator[tuple[str, R]]:
    done, _ = wait(running, return_when=FIRST_COMPLETED)
    for future in done:
        yield running.pop(future), future.result()


def _alone(function: Callable[[J], R], job: J) -> R:
    """Run a job without OpenCV's own threads, which would take the cores of other workers."""
    import cv2

    cv2.setNumThreads(1)
    return function(job)


@contextmanager
def threads(workers: int | None = None) -> Generator[Scheduler]:
    """Threads on this machine, by default one for each core."""
    import cv2

    before, count = cv2.getNumThreads(), workers or _cores()
    with ThreadPoolExecutor(count) as executor:
        try:
            yield Scheduler(executor, count)
        finally:
            executor.shutdown(cancel_futures=True)
            cv2.setNumThreads(before)


@contextmanager
def cluster(address: str) -> Generator[Scheduler]:
    """A running Dask cluster. The jobs of a lost worker are repeated by another.

    Raises `CalibrationError` if it cannot be reached or runs another version of this software.
    """
    try:
        from distributed import Client
    except ImportError:
        raise CalibrationError("--scheduler", "needs Dask: pip install 'brushloop[cluster]'") from None
    untyped: Any = Client
    try:
        client: Any = untyped(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise CalibrationError(f"--scheduler {address}", f"no Dask scheduler there ({one_line(error)})") from None
    try:
        yield Scheduler(client.get_executor(pure=False), _workers(client, address))
    finally:
        client.close()


def _workers(client: Any, address: str) -> int:
    """Threads of the cluster. Raises `CalibrationError` where there are none, or where a worker has other software."""
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise CalibrationError(f"--scheduler {address}", "the cluster has no worker")
    answers: dict[str, Any] = client.run(software, on_error="return")
    for worker, answer in answers.items():
        if answer != software():
            words = one_line(answer) if isinstance(answer, BaseException) else f"has {answer}"
            raise CalibrationError(f"--scheduler {address}", f"worker {worker} {words}; {software()} is needed there")
    return sum(threads.values())


def software() -> str:
    """Version of this software, which every worker must match."""
    return f"brushloop {version('brushloop')} (work {VERSION})"


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def finished(
    scheduler: Scheduler, store: Store | None, function: Callable[[J], Arrays], jobs: Iterable[tuple[str, J]]
) -> Iterator[tuple[str, Arrays]]:
    """Yield (key, result) of every job, in no fixed order: what the store lacks is computed and kept there."""
    ready: list[tuple[str, Arrays]] = []

    def missing() -> Iterator[tuple[str, J]]:
        for key, job in jobs:
            if store is None or (arrays := store.get(key)) is None:
                yield key, job
            else:
                ready.append((key, arrays))

    for key, arrays in scheduler.run(function, missing()):
        if store is not None:
            store.put(key, arrays)
        yield from ready
        ready.clear()
        yield key, arrays
    yield from ready
