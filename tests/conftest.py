"""Rules that hold for every test: no thread and no task outlives it."""

from __future__ import annotations

import asyncio
import functools
import gc
import os
import threading
import time
from collections.abc import AsyncIterator, Iterator

import pytest
import typer.main
import typer.testing
from hypothesis import settings

for _library in ("OPENBLAS", "OMP", "MKL"):
    # Two workers have the machine's cores already: threads that wait for each other there only take them away.
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")

# The same examples every time, so that a failure is that of the change; `make soak` looks for new ones.
# No deadline: how long an example takes is up to whatever else the machine does.
settings.register_profile("same", max_examples=40, derandomize=True, deadline=None)
settings.register_profile("search", max_examples=200, derandomize=False, deadline=None)
settings.load_profile("same")

# What collecting makes lives as long as the worker: looking through it for garbage takes a second each time.
gc.disable()

# Our command line does not change between tests: its tree of commands is built once instead of at every command.
typer.main.get_command = typer.testing._get_command = functools.cache(typer.main.get_command)

# What comes late names the load of the computer; the words that tests compare must not depend on it.
os.getloadavg = lambda: (0.0, 0.0, 0.0)

TOLERATED = ("asyncio_", "pytest_timeout", "ThreadPoolExecutor")
"""Pools that live as long as their loop or process; nothing of ours is called that."""

FIRST = (
    "tests/test_demo.py",
    "tests/collect/tui/test_session.py",
    "tests/collect/photograph/test_checks.py",
    "tests/calibrate/fit",
    "tests/model/test_generator.py",
    "tests/collect/commission/test_first_day.py",
)
"""The longest tests and groups, longest first, so that no worker is left alone with one of them at the end."""

TOGETHER = {
    "tests/test_demo.py": "comparing",
    "tests/test_foreign_text.py": "comparing",
    "tests/calibrate/validate/": "comparing",
    "tests/calibrate/test_scores.py": "comparing",
    "tests/calibrate/test_recover.py": "comparing",
    "tests/calibrate/fit/": "comparing",
    "tests/calibrate/test_writing.py": "comparing",
    "tests/calibrate/test_drags.py": "drags",
    "tests/calibrate/test_pages.py": "pages",
    "tests/calibrate/test_calibration.py": "lens",
    "tests/model/": "model",
    "tests/test_recipes.py::test_a_stroke_model": "model",
}
"""What one worker runs: its first test imports, compiles or records for seconds, which the others then do without."""


@pytest.hookimpl(tryfirst=True)  # before xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: next((n for n, start in enumerate(FIRST) if item.nodeid.startswith(start)), len(FIRST)))
    for item in items:
        for folder, group in TOGETHER.items():
            if item.nodeid.startswith(folder) and item.get_closest_marker("xdist_group") is None:
                item.add_marker(pytest.mark.xdist_group(group))


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    # pytest now collects garbage five times, half a second each; what is alive the first time is left out of the rest.
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def no_thread_outlives_the_test() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 30.0  # for a busy machine
    while True:
        left = [t for t in set(threading.enumerate()) - before if t.is_alive() and not t.name.startswith(TOLERATED)]
        if not left or time.monotonic() > deadline:
            break
        time.sleep(0.01)
    assert not left, f"threads outlive the test: {left}"


@pytest.fixture(autouse=True)
async def no_task_outlives_the_test() -> AsyncIterator[None]:
    before = asyncio.all_tasks()
    yield
    left = [task for task in asyncio.all_tasks() - before - {asyncio.current_task()} if not task.done()]
    assert not left, f"tasks outlive the test: {left}"
