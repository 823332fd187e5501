"""What a benchmark returns and how two contestants are timed fairly."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Protocol


class BenchError(RuntimeError):
    """A benchmark that could not be measured; the message says what was missing."""


@dataclass(frozen=True, slots=True)
class Result:
    """One measurement beside a peer's.

    `value` is ours in `unit`; `peer` says what the peer is; `ratio` compares the two so that above 1 is
    better for us; `n` is how many rounds were timed and `seed` what the inputs were drawn with. `conditions`
    says under what circumstances, where they matter.
    """

    name: str
    value: float
    unit: str
    peer: str
    ratio: float
    n: int
    seed: int
    conditions: str = ""

    def to_json(self) -> str:
        """One line of JSON with exactly the fields above."""
        return json.dumps(asdict(self))

    def to_line(self) -> str:
        """One line for people, without the conditions: many results share theirs."""
        value = f"{self.value:,.0f}" if self.value >= 1000 else f"{self.value:.3g}"
        return (
            f"{self.name}: {value} {self.unit}, {self.ratio:.2f} x {self.peer} "
            f"(above 1 is better; n = {self.n}, seed = {self.seed})"
        )


class Bench(Protocol):
    """A benchmark: measures `n` rounds (its own default when None) on inputs drawn with `seed`."""

    def __call__(self, *, n: int | None = None, seed: int = 0) -> Result | Sequence[Result]:
        """Measure; one result, or several with names of their own. Raises BenchError when it cannot,
        ValueError for n < 1."""
        ...


def results_of(measured: Result | Sequence[Result]) -> Sequence[Result]:
    """What a benchmark returned, as a sequence."""
    return (measured,) if isinstance(measured, Result) else measured


def percentile(values: Sequence[float], percent: float) -> float:
    """The value that `percent` of the values do not exceed (nearest rank). Raises ValueError where there are none."""
    if not values:
        raise ValueError("no values")
    ranked = sorted(values)
    return ranked[max(0, min(len(ranked) - 1, -(-round(percent * len(ranked)) // 100) - 1))]


def machine() -> str:
    """What a figure of time depends on and a reader cannot know."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"Python {platform.python_version()}, {os.cpu_count()} cores{load}"


def interleave(ours: Callable[[], object], peer: Callable[[], object], n: int) -> tuple[float, float]:
    """The median seconds of each over n rounds of ours, peer, ours, peer...; each runs once unmeasured first.

    Taking turns lets a busy or throttled machine slow both alike. Raises ValueError for n < 1.
    """
    if n < 1:
        raise ValueError(f"n = {n}: at least one round is needed")
    ours()
    peer()
    ours_s: list[float] = []
    peer_s: list[float] = []
    for _ in range(n):
        ours_s.append(_seconds(ours))
        peer_s.append(_seconds(peer))
    return statistics.median(ours_s), statistics.median(peer_s)


def _seconds(run: Callable[[], object]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start
