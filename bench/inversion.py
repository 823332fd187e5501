"""How exactly and how fast presses are recovered from images, and whether their intervals keep their word."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bench.harness import Result, machine
from bench.inversion_autograd import invert_rendered
from bench.inversion_commands import intervals
from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from brushloop.model.inversion.noise import Noise
from brushloop.model.inversion.press import Flag, Inverter, Known, Range, Recovered
from brushloop.model.protocol import Basis
from brushloop.model.raster.compiled import coverage_numpy
from brushloop.model.raster.exact import coverage_at

Floats = NDArray[np.float64]
DRAWS, BATCH, SLOW = 500, 50, 50
PX_MM = 0.25
"""So that an anchored press of any cell fits into 128 pixels."""
SENSOR = 0.05
"""Standard deviation of the sensor noise, of full ink."""
HEIGHT_MM, ALPHA_DEG, BINARY_MM, NOMINAL, MS = 0.001, 0.05, 0.02, 95.0, 2.0


@dataclass(frozen=True, slots=True)
class Presses:
    """Drawn presses: what they were and their clean images."""

    depth_mm: Floats
    tilt_deg: Floats
    place_mm: Floats
    heading_deg: Floats
    images: NDArray[np.float32]


def run(*, n: int | None = None, seed: int = 0) -> Sequence[Result]:
    """Recover `n` drawn presses (500 by default): H 11-20 mm, alpha 0-10 deg, 128 x 128, 0.25 mm/px, one thread.

    `-anchor` knows the zero-touch point and the heading; `-shape` knows neither and fits place and heading too.
    Targets: `clean` as drawn; `binary`, more than half covered; `noisy`, with sensor noise of 0.05. Errors are of
    |recovered - true|; the peer of a figure is what was asked for. Times are thread CPU seconds with everything from
    the images to the intervals, in batches of 50; `-one` one image a call; `-autograd` the same fit through
    `coverage_at` and `torch.func.jvp`. `-coverage` is how often the true value lies in the 95 % interval; for a few
    draws it says nothing. `inversion-commands-` are shares of intervals that hold the command on brushes that the model
    family does not contain (`bench.inversion_commands`); `n` does not change these.
    """
    count = DRAWS if n is None else n
    if count < 1:
        raise ValueError(f"n = {count}: at least one draw is needed")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return [*_anchored(count, seed), *_shape_only(count, seed), *intervals(seed)]
    finally:
        torch.set_num_threads(threads)


def presses(count: int, seed: int, known: Known) -> Presses:
    """Draw presses; anchors lie anywhere within a pixel, and without one headings are any."""
    rng = np.random.default_rng(seed)
    height, tilt = rng.uniform(11, 20, count), rng.uniform(0, 10, count)
    jitter = rng.uniform(-0.5, 0.5, (count, 2)) * PX_MM
    mark = ccdbsm(Brush(), torch.from_numpy(height), torch.from_numpy(tilt))
    side = 128 * PX_MM
    if known is Known.ANCHOR:
        heading = np.zeros(count)
        place = np.array([0.8 * side, 0.5 * side]) + jitter
        origin = place + np.column_stack((height * np.tan(np.radians(tilt)), np.zeros(count)))
    else:
        heading = rng.uniform(-180, 180, count)
        middle = (0.5 * (mark.x_min_mm + mark.x_max_mm)).numpy()
        way = np.column_stack((np.cos(np.radians(heading)), -np.sin(np.radians(heading))))
        place = origin = 0.5 * side - middle[:, None] * way + jitter
    images = coverage_numpy(mark, torch.from_numpy(origin), torch.from_numpy(heading), px_mm=PX_MM, threads=1)
    return Presses(height, tilt, place, heading, images)


def _anchored(count: int, seed: int) -> Sequence[Result]:
    drawn = presses(count, seed, Known.ANCHOR)
    labelled = Labelled("anchor", count, seed)
    pixel, rounded = (
        Inverter.of_brush(Basis(Brush()), noise=noise, px_mm=PX_MM) for noise in (Noise.PIXEL, Noise.QUANTISED)
    )
    clean, clean_ms = _recovered(pixel, drawn.images, drawn.place_mm)
    binary, binary_ms = _recovered(rounded, _rounded(drawn.images), drawn.place_mm)
    noisy, _ = _recovered(pixel, _noisy(drawn.images, seed), drawn.place_mm)
    one_ms = _ms(lambda: [pixel(drawn.images[k : k + 1], drawn.place_mm[k]) for k in range(min(count, BATCH))])
    few = min(count, SLOW)
    autograd_ms = _ms(lambda: _autograd(drawn, few)) / few
    return [
        *_errors(labelled, "clean", clean, drawn, worst=True),
        labelled("clean-time", clean_ms, "ms/image", f"the {MS:g} ms asked for", MS / clean_ms),
        labelled("clean-time-one", one_ms / min(count, BATCH), "ms/image", f"the {MS:g} ms asked for",
             MS * min(count, BATCH) / one_ms),
        labelled("clean-time-autograd", clean_ms, "ms/image", "the same fit by autograd", autograd_ms / clean_ms),
        *_errors(labelled, "binary", binary, drawn, worst=False),
        labelled("binary-time", binary_ms, "ms/image", f"the {MS:g} ms asked for", MS / binary_ms),
        *_coverages(labelled, "binary", binary, drawn),
        *_coverages(labelled, "noisy", noisy, drawn),
    ]  # fmt: skip


def _shape_only(count: int, seed: int) -> Sequence[Result]:
    drawn = presses(count, seed, Known.NOTHING)
    labelled = Labelled("shape", count, seed)
    pixel, rounded = (
        Inverter.of_brush(Basis(Brush()), known=Known.NOTHING, noise=noise, px_mm=PX_MM)
        for noise in (Noise.PIXEL, Noise.QUANTISED)
    )
    clean, clean_ms = _recovered(pixel, drawn.images, None)
    binary, binary_ms = _recovered(rounded, _rounded(drawn.images), None)
    noisy, _ = _recovered(pixel, _noisy(drawn.images, seed), None)
    assert all(Flag.ALPHA_UNKNOWN in flags for flags in (*clean.flags, *binary.flags))
    return [
        *_errors(labelled, "clean", clean, drawn, worst=True),
        labelled("clean-time", clean_ms, "ms/image", f"the {MS:g} ms asked for", MS / clean_ms),
        *_errors(labelled, "binary", binary, drawn, worst=False),
        labelled("binary-time", binary_ms, "ms/image", f"the {MS:g} ms asked for", MS / binary_ms),
        *_coverages(labelled, "binary", binary, drawn),
        *_coverages(labelled, "noisy", noisy, drawn),
    ]


@dataclass(frozen=True, slots=True)
class Labelled:
    """Makes results that share a name's beginning, n and seed."""

    known: str
    n: int
    seed: int

    def __call__(self, name: str, value: float, unit: str, peer: str, ratio: float) -> Result:
        """One result."""
        return Result(f"inversion-{self.known}-{name}", value, unit, peer, ratio, self.n, self.seed, machine())


def _errors(labelled: Labelled, name: str, found: Recovered, drawn: Presses, *, worst: bool) -> Sequence[Result]:
    kind = "worst" if worst else "mean"
    off_mm, off_deg = np.abs(found.depth_mm - drawn.depth_mm), np.abs(found.tilt_deg - drawn.tilt_deg)
    mm, deg = (float(off.max() if worst else off.mean()) for off in (off_mm, off_deg))
    asked_mm = HEIGHT_MM if worst else BINARY_MM
    out = [labelled(f"{name}-H-{kind}", mm, "mm", f"the {asked_mm:g} mm asked for", asked_mm / max(mm, 1e-12))]
    if worst:
        asked = f"the {ALPHA_DEG:g} deg asked for"
        return [*out, labelled(f"{name}-alpha-{kind}", deg, "deg", asked, ALPHA_DEG / max(deg, 1e-12))]
    out.append(
        labelled(f"{name}-H-95", float(np.quantile(off_mm, 0.95)), "mm", "the mean", mm / np.quantile(off_mm, 0.95))
    )
    return [
        *out,
        labelled(f"{name}-alpha-{kind}", deg, "deg", "an always guessed 5 deg", _guessed(drawn) / max(deg, 1e-12)),
    ]


def _guessed(drawn: Presses) -> float:
    return float(np.abs(drawn.tilt_deg - 5.0).mean())


def _coverages(labelled: Labelled, name: str, found: Recovered, drawn: Presses) -> Sequence[Result]:
    out: list[Result] = []
    for parameter, true in (("depth_mm", drawn.depth_mm), ("tilt_deg", drawn.tilt_deg)):
        low, high = found.interval(parameter)
        share = 100 * float(((low <= true) & (true <= high)).mean())
        letter = "H" if parameter == "depth_mm" else "alpha"
        out.append(labelled(f"{name}-coverage-{letter}", share, "%", "the nominal 95 %", share / NOMINAL))
    return out


def _recovered(inverter: Inverter, images: NDArray[np.float32], place: Floats | None) -> tuple[Recovered, float]:
    """What was recovered, and ms per image in batches."""
    inverter(images[:2], None if place is None else place[:2])  # compiles
    parts = [slice(k, k + BATCH) for k in range(0, len(images), BATCH)]
    ms = _ms(lambda: [inverter(images[at], None if place is None else place[at]) for at in parts])
    return inverter(images, place), ms / len(images)


def _autograd(drawn: Presses, few: int) -> None:
    # A renderer has one place for all, so all of them are drawn and sought at the first one's.
    def render(values: torch.Tensor) -> torch.Tensor:
        height, tilt = values.unbind(-1)
        ahead = height * torch.tan(torch.deg2rad(tilt))
        origin = torch.stack((drawn.place_mm[0, 0] + ahead, torch.full_like(ahead, drawn.place_mm[0, 1])), dim=-1)
        return coverage_at(ccdbsm(Brush(), height, tilt), origin, px_mm=PX_MM)

    with torch.no_grad():
        pressed = torch.from_numpy(np.column_stack((drawn.depth_mm, drawn.tilt_deg))[:few])
        images = render(pressed).float().numpy()
    found = invert_rendered(render, images, Range((10.0, 21.0), (0.0, 12.0)), anchored=True, px_mm=PX_MM)
    assert np.abs(found.depth_mm - drawn.depth_mm[:few]).max() < HEIGHT_MM


def _rounded(images: NDArray[np.float32]) -> NDArray[np.float32]:
    return (images > 0.5).astype(np.float32)


def _noisy(images: NDArray[np.float32], seed: int) -> NDArray[np.float32]:
    noise = np.random.default_rng(seed + 1).normal(0, SENSOR, images.shape)
    return (images + noise).astype(np.float32)


def _ms(work: object) -> float:
    assert callable(work)
    start = time.thread_time()
    work()
    return 1000 * (time.thread_time() - start)
