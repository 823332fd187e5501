"""What the process of `brushloop validate` keeps in memory of each stroke: while it compares, and while it reports."""

from __future__ import annotations

import gc
import tempfile
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from bench.harness import Result
from bench.press_sessions import Presses, session
from calibrate.validate import main
from calibrate.validate.main import Request, validate
from sessions.progress import unseen

STROKES = 240
FEW = 4


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Bytes of Python's and numpy's memory that each stroke beyond the first quarter of `n` (240) takes.

    `validate-kept` is held when all strokes are compared; `validate-kept-report` is the most while the report is made,
    which holds the former. ratio = 1,600 bytes, an earlier estimate, over ours. Raises ValueError for fewer than 40
    strokes, where what is the same for any number outweighs them.
    """
    strokes = STROKES if n is None else n
    if strokes < 40:
        raise ValueError(f"n = {n}: at least 40 strokes are needed")
    few = strokes // FEW
    with tempfile.TemporaryDirectory() as folder:
        under = Path(folder)
        places = {count: session(under, f"of-{count}", Presses(count, seed)) for count in (few, strokes)}
        _held(places[few], under / "first")  # what is loaded, compiled and cached once
        (few_b, few_peak_b), (all_b, all_peak_b) = (_held(place, under / f"{n}") for n, place in places.items())
    where = f"loopback rig, {few} and {strokes} presses, no held-out fits"
    more = strokes - few
    found = {"validate-kept": (all_b - few_b) / more, "validate-kept-report": (all_peak_b - few_peak_b) / more}
    return [
        Result(name, each_b, "bytes a stroke", "an estimate of 1,600", 1600 / each_b, strokes, seed, where)
        for name, each_b in found.items()
    ]


def _held(place: Path, out: Path) -> tuple[int, int]:
    """Traced bytes when the strokes are compared, and the most from then on."""
    compared_b = 0
    write = main._write  # pyright: ignore[reportPrivateUsage]

    def noted(*arguments: Any) -> Any:
        nonlocal compared_b
        gc.collect()
        compared_b = tracemalloc.get_traced_memory()[0]
        tracemalloc.reset_peak()
        return write(*arguments)

    tracemalloc.start()
    try:
        with mock.patch.object(main, "_write", noted):
            output = validate(Request((str(place),), "bench kept", out=out, held_out=False), unseen)
        assert output.report is not None
        return compared_b, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
