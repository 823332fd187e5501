"""What a benchmark returns and how two contestants are timed fairly."""

from __future__ import annotations

import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Protocol, TypedDict


class BenchError(RuntimeError):
    """A benchmark that could not be measured; the message says what was missing."""


@dataclass(frozen=True, slots=True)
class Result:
    """One measurement beside a peer's.

    `value` is ours in `unit`; `peer` says what the peer is; `ratio` compares the two so that above 1 is
    better for us; `n` is how many rounds were timed and `seed` what the inputs were drawn with. `conditions`
    says under what circumstances, where they matter. `quickest` and `median` are the ratio by the mean of the quickest
    tenth of the rounds and by their medians, where rounds of both were timed.
    """

    name: str
    value: float
    unit: str
    peer: str
    ratio: float
    n: int
    seed: int
    conditions: str = ""
    quickest: float | None = None
    median: float | None = None

    def to_json(self) -> str:
        """One line of JSON with exactly the fields above."""
        return json.dumps(asdict(self))

    def to_line(self) -> str:
        """One line for people, without the conditions: many results share theirs."""
        value = f"{self.value:,.0f}" if self.value >= 1000 else f"{self.value:.3g}"
        both = "" if self.quickest is None else f"quickest tenth {self.quickest:.2f}, median {self.median:.2f}; "
        return (
            f"{self.name}: {value} {self.unit}, {self.ratio:.2f} x {self.peer} "
            f"(above 1 is better; {both}n = {self.n}, seed = {self.seed})"
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


class Ratios(TypedDict):
    """Two fields of a `Result`."""

    quickest: float
    median: float


@dataclass(frozen=True, slots=True)
class Turns:
    """The seconds of each round of ours and of the peer's, which took turns."""

    ours_s: tuple[float, ...]
    peer_s: tuple[float, ...]

    @property
    def quickest_s(self) -> tuple[float, float]:
        """The mean of the quickest tenth of the rounds of each: other work on the machine only ever slows."""
        few = max(1, round(0.1 * len(self.ours_s)))
        return statistics.fmean(sorted(self.ours_s)[:few]), statistics.fmean(sorted(self.peer_s)[:few])

    @property
    def median_s(self) -> tuple[float, float]:
        """The median of each."""
        return statistics.median(self.ours_s), statistics.median(self.peer_s)

    def ratios(self, share: float = 1.0) -> Ratios:
        """`quickest` and `median` of a `Result`: the peer's time over ours, times `share`, by either."""
        (a, b), (c, d) = self.quickest_s, self.median_s
        return Ratios(quickest=share * b / a, median=share * d / c)


def interleave(
    ours: Callable[[], object], peer: Callable[[], object], n: int, clock: Callable[[], float] = time.perf_counter
) -> Turns:
    """Time n rounds of ours, peer, ours, peer...; each runs once unmeasured first.

    Taking turns lets a busy or throttled machine slow both alike. Raises ValueError for n < 1.
    """
    if n < 1:
        raise ValueError(f"n = {n}: at least one round is needed")
    taken: tuple[list[float], list[float]] = ([], [])
    for round_ in range(n + 1):
        for run, times in zip((ours, peer), taken, strict=True):
            began = clock()
            run()
            if round_:
                times.append(clock() - began)
    return Turns(tuple(taken[0]), tuple(taken[1]))
