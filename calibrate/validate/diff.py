"""Comparison of two reports: what got better or worse, with a paired test.

Pairs are, in order of preference: the same stroke of the same recording (two software versions, or two sets of
options); the averages of the same cell in two sessions.
"""

from __future__ import annotations

import csv
import shlex
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from rich.table import Table

from brushloop.calibrate.commands import DiffRequest
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.scores import MEASURES
from brushloop.calibrate.stats import Paired, holm, paired
from brushloop.calibrate.validate.tables import Report, load_report
from brushloop.sessions.disk import as_text, file_sha256
from brushloop.sessions.terminal import Progress, unseen

SIGNIFICANT = 0.05
Series = tuple[str, str, str, str]
"""Model, alignment, tone, measure."""
Strokes = dict[tuple[str, ...], float]
"""Scores by (H, alpha) and, where the same strokes are compared, recording and stroke."""


@dataclass(frozen=True, slots=True)
class Change:
    """One series, `after` minus `before` in points (percent)."""

    series: Series
    before: float
    after: float
    test: Paired
    p_holm: float
    """p-value corrected for the number of series compared."""

    @property
    def verdict(self) -> str:
        """`better`, `worse` or `no significant difference`, by `p_holm`."""
        if self.p_holm > SIGNIFICANT:
            return "no significant difference"
        return "better" if self.test.mean > 0 else "worse"


@dataclass(frozen=True, slots=True)
class Difference:
    """Two reports compared."""

    before: Report
    after: Report
    by_stroke: bool
    """Whether the same strokes are paired; else the averages of the same cells."""
    changes: list[Change]

    def lines(self) -> Iterator[object]:
        """What the command prints: what is compared, and the changes."""
        for words, side in (("Before", self.before), ("After", self.after)):
            names = ", ".join(session.session_id for session in side.sessions[:4])
            yield f"{words}: {names}, brushloop {side.software['brushloop']}."
        what = "the same stroke" if self.by_stroke else "the average of the same (H, α)"
        test = self.changes[0].test
        yield (
            f"Paired by {what}, n = {test.n} in {test.groups} cells; p by flipping the signs of whole cells, corrected "
            f"by Holm for {len(self.changes)} series ({self.before.label})."
        )
        if not self.by_stroke:
            yield "Two sessions also differ in things that were not meant to change: brush, ink, paper, zero touch."
        title = f"after minus before, points of percent ({self.before.label})"
        table = Table("model", "images", "", "before", "after", "change", "95 %", "p", "", title=title)
        for change in self.changes:
            name, alignment, tone, measure = change.series
            span = change.test.interval
            table.add_row(
                *(name, f"{alignment}, {tone}", measure.upper(), f"{change.before:.2f}", f"{change.after:.2f}"),
                *(f"{change.test.mean:+.3f}", "" if span is None else f"{span[0]:+.2f} to {span[1]:+.2f}"),
                *(f"{change.p_holm:.3f}", change.verdict),
            )
        yield table


def compare(request: DiffRequest, _progress: Progress = unseen) -> Difference:
    """Compare two reports, or two validated sessions. Raises `CalibrationError` if they are not comparable."""
    paths = report_path(request.before), report_path(request.after)
    old, new = (load_report(path) for path in paths)
    if old.source != new.source:
        what = f"is of {new.source}, {paths[0]} of {old.source}: they cannot be compared"
        raise CalibrationError(str(paths[1]), what)
    by_stroke = bool({s.recording_sha256 for s in old.sessions} & {s.recording_sha256 for s in new.sessions})
    first, last = (_scores(path, side, by_stroke=by_stroke) for path, side in zip(paths, (old, new), strict=True))
    found: list[tuple[Series, float, float, Paired]] = []
    for series in (series for series in first if series in last):
        both = sorted(first[series].keys() & last[series].keys())
        values = 100.0 * np.array([[side[series][key] for key in both] for side in (first, last)])
        # The error of a model is common to all strokes of a cell.
        cells = np.unique([",".join(key[:2]) for key in both], return_inverse=True)[1]
        if both and (test := paired(values[0], values[1], cells)) is not None:
            found.append((series, float(values[0].mean()), float(values[1].mean()), test))
    if not found:
        raise CalibrationError(str(paths[1]), f"has no stroke, cell or model in common with {paths[0]}")
    corrected = holm([test.p for *_, test in found])
    return Difference(old, new, by_stroke, [Change(*change, p) for change, p in zip(found, corrected, strict=True)])


def report_path(place: Path) -> Path:
    """Find report.json: the file given, or the one in a report's or session's folder, or next to a recording.

    If there is none, raises `CalibrationError` that names the command to run.
    """
    if not place.exists():
        raise CalibrationError(str(place), "does not exist: give a report.json, or a session that was validated")
    if place.is_file() and place.suffix == ".json":
        return place
    # Search only a recording's own folder: a report next to a session's folder may be about several sessions.
    folder = place.parent if place.is_file() else place
    for path in (folder / "report.json", folder / "validation" / "report.json"):
        if path.is_file():
            return path
    why = f"was not validated: run `brushloop validate {shlex.quote(str(place))}` first, or give a report.json"
    raise CalibrationError(str(place), why)


def _scores(path: Path, report: Report, *, by_stroke: bool) -> dict[Series, Strokes]:
    """Read scores by cell, recording and stroke, or averaged by cell. Raises `CalibrationError` for an edited table."""
    table = path.with_name("scores.csv")
    if not table.is_file() or file_sha256(table) != report.scores_sha256:
        raise CalibrationError(str(table), f"is not the table of {path.name}: its SHA-256 differs")
    recordings = {s.session_id: s.recording_sha256 for s in report.sessions}
    scores: defaultdict[Series, defaultdict[tuple[str, ...], list[float]]] = defaultdict(lambda: defaultdict(list))
    with table.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            cell = (row["depth_mm"], row["tilt_deg"])
            key = (*cell, recordings[row["session_id"]], as_text(row["stroke_id"])) if by_stroke else cell
            for measure in MEASURES:
                scores[row["model"], row["alignment"], row["tone"], measure][key].append(float(row[measure]))
    return {series: {key: fmean(of_key) for key, of_key in keys.items()} for series, keys in scores.items()}
