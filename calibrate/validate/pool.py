"""Where jobs run: threads of this machine, or a Dask cluster. Both give the same results, in no fixed order.

Threads, not processes: the work is OpenCV and compiled loops, which let other threads run, and a thread starts at once,
while a process first spends seconds on imports (`bench validate` measures both).
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from importlib.metadata import version
from types import TracebackType
from typing import Any, ClassVar, Protocol, TypeVar

from brushloop.calibrate.errors import one_line
from brushloop.calibrate.validate import store

J = TypeVar("J")
R = TypeVar("R")
AHEAD = 2
"""Jobs submitted per worker; more would only hold photographs in memory."""
BATCH = 4
"""Jobs in one message to a worker of a cluster, since each message costs milliseconds."""
CONNECT_S = 10.0


class ClusterError(Exception):
    """A cluster that cannot be used, with the reason in one line."""

    exit_code: ClassVar[int] = 2


class Scheduler(Protocol):
    """Runs a function over named jobs."""

    @property
    def workers(self) -> int:
        """Number of jobs that run at a time."""
        ...

    def run(self, function: Callable[[J], R], jobs: Iterator[tuple[str, J]]) -> Iterator[tuple[str, R]]:
        """Yield (name, result) as jobs finish. A job is taken from the iterator only when there is room for it."""
        ...


class Threads(AbstractContextManager["Threads"]):
    """Threads on this machine, by default one for each core."""

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or _cores()
        self._pool = ThreadPoolExecutor(self.workers)
        import cv2

        # One job per core keeps the cores busy; threads inside a job would only compete with each other.
        self._before = cv2.getNumThreads()
        cv2.setNumThreads(1)

    def run(self, function: Callable[[J], R], jobs: Iterator[tuple[str, J]]) -> Iterator[tuple[str, R]]:
        """See `Scheduler.run`."""
        running: dict[Future[R], str] = {}
        try:
            for name, job in jobs:
                running[self._pool.submit(function, job)] = name
                while len(running) >= AHEAD * self.workers:
                    yield from _finished(running)
            while running:
                yield from _finished(running)
        finally:
            for future in running:
                future.cancel()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import cv2

        self._pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(self._before)


def _finished(running: dict[Future[R], str]) -> Iterator[tuple[str, R]]:
    done, _ = wait(running, return_when=FIRST_COMPLETED)
    for future in done:
        yield running.pop(future), future.result()


class Dask(AbstractContextManager["Dask"]):
    """A running Dask cluster. The jobs of a lost worker are repeated by another.

    Raises ClusterError if it cannot be reached or runs another version of this software.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise ClusterError("--scheduler needs Dask: pip install 'brushloop[cluster]'") from None
        untyped: Any = Client
        try:
            self._client: Any = untyped(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            raise ClusterError(f"--scheduler {address}: no Dask scheduler there ({one_line(error)})") from None
        try:
            self.workers = self._check(address)
        except BaseException:
            self._client.close()
            raise

    def _check(self, address: str) -> int:
        threads: dict[str, int] = self._client.nthreads()
        if not threads:
            raise ClusterError(f"--scheduler {address}: the cluster has no worker")
        found: dict[str, Any] = self._client.run(software, on_error="return")
        for worker, answer in found.items():
            if answer != software():
                words = one_line(answer) if isinstance(answer, BaseException) else f"has {answer}"
                raise ClusterError(f"--scheduler {address}: worker {worker} {words}; {software()} is needed there")
        return sum(threads.values())

    def run(self, function: Callable[[J], R], jobs: Iterator[tuple[str, J]]) -> Iterator[tuple[str, R]]:
        """See `Scheduler.run`."""
        from distributed import as_completed

        names: dict[Any, list[str]] = {}

        def submit() -> Any:
            entries = list(itertools.islice(jobs, BATCH))
            if not entries:
                return None
            future = self._client.submit(_alone, function, [job for _, job in entries], pure=False)
            names[future.key] = [name for name, _ in entries]
            return future

        first = [future for _ in range(AHEAD * self.workers) if (future := submit()) is not None]
        if not first:
            return
        completed: Any = as_completed
        going = completed(first, loop=self._client.loop, with_results=True)
        for future, found in going:
            # Submit the next batch before the results of this one are stored.
            more = submit()
            if more is not None:
                going.add(more)
            results: list[R] = found
            yield from zip(names.pop(future.key), results, strict=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()


def _alone(function: Callable[[J], R], jobs: list[J]) -> list[R]:
    """Run jobs on a worker without OpenCV's own threads, which would take the cores of other workers."""
    import cv2

    cv2.setNumThreads(1)
    return [function(job) for job in jobs]


def software() -> str:
    """Version of this software, which every worker must match."""
    return f"brushloop {version('brushloop')} (work {store.VERSION})"


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
