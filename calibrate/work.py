"""Finished work of a session: kept in its folder, so that no command does it again, and what is missing is done.

A key names everything that the arrays of some work depend on, so an entry never has to be changed. Each entry is a file
of its own, an `.npz` archive without pickles in gzip, whose checksum tells damage: work that is damaged, too large or
missing is done again. The folder may be deleted at any time.

Jobs run in threads of this machine or on a Dask cluster. Both give the same results, in no fixed order. Threads, not
processes: the work is OpenCV and compiled loops, which let other threads run, and a thread starts at once, while a
process first spends seconds on imports.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.errors import CalibrationError
from brushloop.sessions.disk import replacing
from brushloop.sessions.errors import in_one_line

J = TypeVar("J")
VERSION = "8"
"""Part of every key. Increase it when the result of some work for the same input changes."""
FOLDER = "work"
"""Folder of a session that holds its finished work."""
MAX_ENTRY_BYTES = 16 * 1024**2
"""Largest entry once it is unpacked."""
UNREADABLE = (OSError, EOFError, ValueError, zlib.error, zipfile.BadZipFile)
AHEAD = 2
"""Jobs submitted per worker; more would only hold photographs in memory."""
CONNECT_S = 10.0
Arrays = Mapping[str, NDArray[Any]]


def key_of(*parts: object) -> str:
    """A key for everything that determines some work; arrays count with shape, type and values."""
    digest = hashlib.sha256(VERSION.encode())
    for part in parts:
        if isinstance(part, np.ndarray):
            array = cast("NDArray[Any]", part)
            digest.update(f"\0{array.dtype} {array.shape} ".encode() + array.tobytes())
        else:
            digest.update(f"\0{part}".encode())
    return digest.hexdigest()


class Store:
    """The entries of one folder by key. Where they cannot be written, the work of a read-only session is done again."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: str) -> Arrays | None:
        """The arrays of an entry; None where there is none, or it is damaged: it is then put again."""
        try:
            with gzip.open(self._path(key)) as file:
                data = file.read(MAX_ENTRY_BYTES)  # a larger entry is cut off, and so damaged
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                return dict(arrays)
        except UNREADABLE:
            return None

    def put(self, key: str, arrays: Arrays) -> None:
        """Add an entry, if the folder can be written; once this returns, killing the process does not lose it."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **dict(arrays))
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            with replacing(self._path(key)) as part:
                part.write_bytes(gzip.compress(buffer.getvalue(), compresslevel=1, mtime=0))

    def _path(self, key: str) -> Path:
        return self._folder / f"{key}.npz.gz"


@dataclass(frozen=True, slots=True)
class Scheduler:
    """Where jobs run."""

    executor: Executor
    workers: int
    """Number of jobs that run at a time."""

    def finished(
        self, function: Callable[[J], Arrays], jobs: Iterable[tuple[str, J]], store: Store | None = None
    ) -> Iterator[tuple[str, Arrays]]:
        """Yield (key, result) of every job, in no fixed order: what the store lacks is done and kept there.

        A job is taken from the iterator only when there is room for it.
        """
        running: dict[Future[Arrays], str] = {}

        def done() -> Iterator[tuple[str, Arrays]]:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                key, arrays = running.pop(future), future.result()
                if store is not None:
                    store.put(key, arrays)
                yield key, arrays

        try:
            for key, job in jobs:
                if store is not None and (kept := store.get(key)) is not None:
                    yield key, kept
                    continue
                running[self.executor.submit(_alone, function, job)] = key
                while len(running) >= AHEAD * self.workers:
                    yield from done()
            while running:
                yield from done()
        finally:
            for future in running:
                future.cancel()


def _alone(function: Callable[[J], Arrays], job: J) -> Arrays:
    """Run a job without OpenCV's own threads, which would take the cores of other workers."""
    import cv2

    cv2.setNumThreads(1)
    return function(job)


@contextmanager
def threads(workers: int | None = None) -> Generator[Scheduler]:
    """Threads on this machine, by default one for each core."""
    import cv2

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    before, count = cv2.getNumThreads(), workers or cores
    with ThreadPoolExecutor(count) as executor:
        try:
            yield Scheduler(executor, count)
        finally:
            executor.shutdown(cancel_futures=True)
            cv2.setNumThreads(before)


@contextmanager
def cluster(address: str) -> Generator[Scheduler]:
    """A running Dask cluster. The jobs of a lost worker are repeated by another.

    Raises `CalibrationError` if it cannot be reached, has no worker, or a worker runs another version of this software.
    """
    where = f"--scheduler {address}"
    try:
        from distributed import Client
    except ImportError:
        raise CalibrationError("--scheduler", "needs Dask: pip install 'brushloop[cluster]'") from None
    untyped: Any = Client
    try:
        client: Any = untyped(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError) as error:
        raise CalibrationError(where, f"no Dask scheduler answers ({in_one_line(error)})") from None
    try:
        answers: dict[str, Any] = client.run(software, on_error="return")
        if not answers:
            raise CalibrationError(where, "the cluster has no worker")
        for worker, answer in answers.items():
            if answer != software():
                version_there = " ".join(str(answer).split())
                raise CalibrationError(where, f"worker {worker} has {version_there}; {software()} is needed there")
        yield Scheduler(client.get_executor(pure=False), sum(client.nthreads().values()))
    finally:
        client.close()


def software() -> str:
    """Version of this software, which every worker must match."""
    return f"brushloop {version('brushloop')} (work {VERSION})"
