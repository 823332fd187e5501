"""The one table of scores: every comparison of a captured press with images, in memory; its files and its statistics.

Tables 1 and 2, gates and figures are queries on it.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare import KEYS, Alignment, Key, Pixels, Tone, similarity
from brushloop.calibrate.presses import Press
from brushloop.calibrate.stats import CEILING, Floats, Integers, Summary, summarise
from brushloop.model.presses import DepthTilt
from brushloop.sessions.disk import csv_text, replacing
from brushloop.sessions.records import Condition

MEASURES = ("csim", "ssim")
NUMBERS = ("depth_mm", "reached_mm", "tilt_deg", *MEASURES)


class Score(NamedTuple):
    """Similarity, from 0 to 1, of one captured press and what a model predicts for it: a line of `scores.csv`."""

    session_id: str
    stroke_id: str
    depth_mm: float
    """As commanded."""
    reached_mm: float | None
    """Depth that the arm reached; None where the recording does not say."""
    tilt_deg: float
    model: str
    """The model, or the kind of press that the press is compared with."""
    alignment: Alignment
    tone: Tone
    csim: float
    ssim: float
    source: str
    """Label of the recording."""


class Scores:
    """CSIM and SSIM, from 0 to 1, of every press and model; NaN where there is nothing to compare with."""

    def __init__(self, presses: Sequence[Press], models: Sequence[str]) -> None:
        self.presses, self.models = tuple(presses), tuple(models)
        """Presses by session and order of capture, and names of models."""
        self.values = np.full((len(presses), len(models), len(KEYS), 2), np.nan)
        order = list(dict.fromkeys(press.session for press in presses))
        places = [(order.index(press.session), press.condition) for press in presses]
        numbers = {place: number for number, place in enumerate(sorted(set(places)))}
        self.group_of: Integers = np.array([numbers[place] for place in places], np.int64)
        """(presses,) number of each press's group, which is one condition in one session, by session and condition."""
        self.groups: list[list[int]] = [np.flatnonzero(self.group_of == number).tolist() for number in numbers.values()]
        """Numbers of the presses of each group."""

    def __iter__(self) -> Iterator[Score]:
        """The scores by session, order of capture and model; those that are missing are left out."""
        for press, of_press in zip(self.presses, self.values, strict=True):
            at = press.condition.depth_mm, press.stroke.reached_mm, press.condition.tilt_deg
            for model, values in zip(self.models, of_press.tolist(), strict=True):
                for key, (csim, ssim) in zip(KEYS, values, strict=True):
                    if math.isfinite(csim):
                        yield Score(press.session, press.stroke.stroke_id, *at, model, *key, csim, ssim, press.source)

    def of(self, model: str) -> Floats:
        """(presses, KEYS, 2) scores of one model."""
        return self.values[:, self.models.index(model)]

    def of_key(self, model: str, key: Key) -> Floats:
        """(presses, 2) CSIM and SSIM of one model in one alignment and tone."""
        return self.of(model)[:, KEYS.index(key)]

    def conditions(self) -> dict[Condition, list[int]]:
        """Numbers of the presses of each condition in any session, sorted by condition."""
        numbers: dict[Condition, list[int]] = {}
        for group in self.groups:
            numbers.setdefault(self.presses[group[0]].condition, []).extend(group)
        return dict(sorted(numbers.items()))


def scores_csv(scores: Scores) -> str:
    """Every score, as the text of a CSV file."""
    rows = ((*score[:-3], f"{score.csim:.8f}", f"{score.ssim:.8f}", score.source) for score in scores)
    return csv_text(Score._fields, rows)


def write_parquet(scores: Scores, label: str, path: Path) -> list[str]:
    """Write the same rows as Parquet; returns the file's name, or nothing where pyarrow is not installed."""
    if find_spec("pyarrow") is None:
        return []
    pa: Any = importlib.import_module("pyarrow")  # without type stubs
    pq: Any = importlib.import_module("pyarrow.parquet")
    kinds = [(name, pa.float64() if name in NUMBERS else pa.string()) for name in Score._fields]
    rows = [score._asdict() for score in scores]
    with replacing(path) as part:
        pq.write_table(pa.Table.from_pylist(rows, schema=pa.schema(kinds, metadata={"source": label})), part)
    return [path.name]


class Stat(Frozen):
    """CSIM and SSIM of one model in one alignment and tone, in percent, over all conditions or in one."""

    model: str
    alignment: Alignment
    tone: Tone
    cell: DepthTilt | None
    """The condition; None for all."""
    csim: Summary
    ssim: Summary


def statistics(
    model: str, percent: Floats, groups: Integers, condition: DepthTilt | None = None, ceiling: Floats | None = None
) -> Iterator[Stat]:
    """Yield the statistics of a model's scores, (rows, KEYS, 2) percent, for each of `KEYS` in which it has any.

    `groups` (rows,) are numbers of conditions. With a `ceiling` of the shape of `percent`, each statistic says how far
    below it is.
    """

    def summary(values: Floats, top: Floats | None) -> Summary | None:
        summary = summarise(values, groups)
        if summary is not None and model == CEILING:
            return replace(summary, max=None, min=None, median=None)
        if summary is None or top is None or (below := summarise(top - values, groups)) is None:
            return summary
        avg = round(float(values[np.isfinite(top - values)].mean()), 6)
        summary = replace(summary, below_ceiling=below.avg, below_interval=below.avg_interval)
        return replace(summary, below_n=below.n, below_avg=avg)

    for k, (alignment, tone) in enumerate(KEYS):
        csim, ssim = (summary(percent[:, k, j], None if ceiling is None else ceiling[:, k, j]) for j in (0, 1))
        if csim is not None and ssim is not None:
            yield Stat(model=model, alignment=alignment, tone=tone, cell=condition, csim=csim, ssim=ssim)


def similarities(press: Pixels, compared: Sequence[Sequence[Pixels]]) -> Floats:
    """(comparisons, KEYS, 2) mean CSIM and SSIM of a press, (KEYS, 128, 128), and the images of each comparison.

    NaN where a comparison has no image, or a blank one.
    """
    means = np.full((len(compared), len(KEYS), 2), np.nan)
    images = [image for of_one in compared for image in of_one]
    ends = np.cumsum([len(of_one) for of_one in compared])
    for k, (alignment, _) in enumerate(KEYS) if images else ():
        others = np.stack([image[k] for image in images]) / 255.0
        each = np.split(similarity(press[k] / 255.0, others, alignment), ends[:-1])
        for mean, scores in zip(means, each, strict=True):
            mean[k] = scores.mean(axis=0) if len(scores) else np.nan
    return means
