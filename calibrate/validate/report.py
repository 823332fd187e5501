"""The report as data: what was validated with what, and the statistics of every model.

Everything in terminal, JSON, tables, gates and comparisons comes from it.
"""

from __future__ import annotations

import itertools
import platform
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar

import numpy as np

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare.place import KEYS, Alignment, Key, Tone, brush_of
from brushloop.calibrate.loop.scores import LoopRecord
from brushloop.calibrate.report import Sealed, load_sealed, source_label
from brushloop.calibrate.scores import Numbers, Row, Scores, Values
from brushloop.calibrate.stats import CEILING, average, ceiling_values, summarise
from brushloop.calibrate.validate.inputs import Extras, FittedSession, one_source
from brushloop.calibrate.validate.models import (
    ANOTHER,
    FITTED,
    FITTED_HELD_OUT,
    KINDS_OF_PRESS,
    ModelInfo,
)
from brushloop.calibrate.validate.run import Outcome, Refused, Step
from brushloop.calibrate.writing.scores import WrittenRecord
from brushloop.model.ccdbsm import DomainError
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.events import CaptureResult, DipResult, ZeroTouchResult
from brushloop.sessions.journal import JOURNAL_NAME, replay
from brushloop.sessions.records import Condition, Header, Source
from brushloop.sessions.show import details

FORMAT = "brushloop-validation-2"
MAX_BYTES = 256 * 1024 * 1024
PACKAGES = ("numpy", "opencv-python-headless", "scikit-image", "numba", "torch")
MEASURES = ("csim", "ssim")
MAX_CELLS = 60


class Stat(Frozen):
    """One model's scores in one alignment and tone, in percent, over all cells or of one (depth and tilt)."""

    model: str
    alignment: Alignment
    tone: Tone
    measure: str
    """`csim` or `ssim`."""
    depth_mm: float | None
    tilt_deg: float | None
    n: int
    max: float | None
    min: float | None
    avg: float
    avg_low: float | None
    avg_high: float | None
    """95 % interval by bootstrap over the presses of each cell, or over cells if these have few presses."""
    median: float | None
    """None for the ceiling, as are the extremes: it is an average of its own, not of scores."""
    median_low: float | None
    median_high: float | None
    below_ceiling: float | None = None
    """Points below the ceiling over all cells together; None where no cell was pressed twice."""
    below_low: float | None = None
    below_high: float | None = None
    """95 % interval of that difference, which resamples whole cells."""

    @property
    def cell(self) -> tuple[float, float] | None:
        """Depth and tilt; None for all cells together."""
        return None if self.depth_mm is None or self.tilt_deg is None else (self.depth_mm, self.tilt_deg)


class Collected(Frozen):
    """How the strokes were collected, from the session's journal."""

    planned: int | None
    """Number of strokes; None unless the protocol is a grid."""
    photographed: int
    pressed_again: tuple[str, ...]
    """Stroke of each take that did not count and was repeated."""
    left_out: tuple[str, ...]
    touches: tuple[str, ...]
    """Method and height of every zero touch."""
    moved_mm: float
    """Highest minus lowest height of the paper."""


class DepthMiss(Frozen):
    """A stroke, the depth that was commanded and the one that the arm reached."""

    stroke_id: str
    depth_mm: float
    reached_mm: float


class Scale(Frozen):
    """The calibration of a session, with the 95 % interval of its scale."""

    named: str
    """Digest, and the label if there is one."""
    mm_per_px: float
    low: float
    high: float
    rms_px: float


class Session(Frozen):
    """A recording, and the artefacts that were used with it."""

    header: Header
    recording: str
    recording_sha256: str
    strokes: int
    compared: int
    cut: tuple[str, ...]
    calibration: Scale | None
    """None for an import, which brings its own scale."""
    fit: str
    length_ratio: float | None
    width_ratio: float | None
    """Measured size divided by that of CCD-BSM as published, averaged over uncut strokes."""
    deepest_miss: DepthMiss | None = None
    """The stroke whose depths differ most; None where the recording has no reached depths."""
    collected: Collected | None = None
    """None without a journal: for imports, and for recordings sent without it."""

    @property
    def session_id(self) -> str:
        """Its name."""
        return self.header.session_id

    @property
    def brush(self) -> str:
        """The brush and its size, where the header names them."""
        header, size = self.header, ""
        if header.brush_radius_mm is not None and header.brush_length_mm is not None:
            size = f"R = {header.brush_radius_mm:g} mm, L = {header.brush_length_mm:g} mm"
        return ", ".join(part for part in (header.brush, size) if part)


class Report(Sealed):
    """All results of a validation."""

    FORMAT: ClassVar[str] = FORMAT
    MADE_BY: ClassVar[str] = "brushloop validate"

    format: str = FORMAT
    source: Source
    """Kind of ink, from the recordings' own headers; shown on all tables and figures."""
    software: dict[str, str]
    command: str
    mm_per_px: float
    ssim_settings: str
    sessions: tuple[Session, ...]
    models: tuple[ModelInfo, ...]
    """Rows of the tables: models, then comparisons with presses."""
    shown: str
    """Model shown in the pictures: the best calibrated one on held-out cells, if there is one."""
    stats: tuple[Stat, ...]
    cells_told: bool
    """False if there are too many different (H, alpha) for a table of each."""
    refused: tuple[Refused, ...]
    by_strokes: tuple[Step, ...]
    """Similarity against number of strokes; empty without --ablations."""
    scores_sha256: str
    """Hash of scores.csv in the same folder."""
    loops: tuple[LoopRecord, ...] = ()
    """Strokes of these sessions that were pressed again: the third row of Table 1."""
    written: tuple[WrittenRecord, ...] = ()
    """Characters: Table 3. Each record here and in `loops` keeps its own digest."""

    def stat(
        self, model: str, alignment: Alignment, tone: Tone, measure: str, cell: tuple[float, float] | None = None
    ) -> Stat | None:
        """The scores of one model, or None if it has none."""
        wanted = (model, alignment, tone, measure, cell)
        rows = (s for s in self.stats if (s.model, s.alignment, s.tone, s.measure, s.cell) == wanted)
        return next(rows, None)

    def model(self, name: str) -> ModelInfo | None:
        """The model of that name, or None if it has no score."""
        return next((model for model in self.models if model.name == name), None)

    @property
    def label(self) -> str:
        """Label of every table and figure."""
        return source_label(self.source, (session.brush for session in self.sessions))


def load_report(path: Path) -> Report:
    """Read a report.json. Raises `CalibrationError` if it is not one or was edited."""
    return load_sealed(path, Report, MAX_BYTES)


def report_of(outcome: Outcome, command: str, scores_sha256: str, extras: Extras) -> Report:
    """Build one frozen report of a whole run."""
    scores, conditions = outcome.scores, outcome.scores.conditions()
    each_cell = len(conditions) <= MAX_CELLS
    groups: list[tuple[Condition | None, Numbers]] = [(None, np.arange(len(scores.rows)))]
    stats = tuple(_stats(scores, [*groups, *(conditions.items() if each_cell else ())]))
    scored = {stat.model for stat in stats}
    present = [name for name in (*scores.models, CEILING) if name in scored]
    order = (FITTED_HELD_OUT, FITTED, "ccd-bsmg", "ccd-bsm", *present)
    report = Report(
        source=one_source(outcome.sessions),
        software={"brushloop": version("brushloop"), "python": platform.python_version()}
        | {name: version(name) for name in PACKAGES},
        command=command,
        mm_per_px=outcome.options.view.mm_per_px,
        ssim_settings=SSIM_SETTINGS,
        sessions=tuple(_session(one, scores) for one in outcome.sessions),
        models=(*_models(outcome), *(kind for kind in KINDS_OF_PRESS if kind.name in present)),
        shown=next((name for name in order if name in present), ""),
        stats=stats,
        cells_told=each_cell,
        refused=tuple(outcome.refused),
        by_strokes=tuple(outcome.steps),
        scores_sha256=scores_sha256,
        loops=extras.loops,
        written=extras.written,
    )
    return report.sealed()


def _stats(scores: Scores, groups: Sequence[tuple[Condition | None, Numbers]]) -> Iterator[Stat]:
    """Yield the statistics of each group of rows: all cells together, then single conditions."""
    top: Values = np.apply_along_axis(ceiling_values, 0, 100.0 * scores.of(ANOTHER), scores.cell_of)
    kinds = {kind.name for kind in KINDS_OF_PRESS}
    for condition, at in groups:
        cells = scores.cell_of[at]
        for model in (*scores.models, CEILING):
            values = (top if model == CEILING else 100.0 * scores.of(model))[at]
            for (k, key), (j, measure) in itertools.product(enumerate(KEYS), enumerate(MEASURES)):
                below = None
                if condition is None and model not in kinds:
                    below = top[at, k, j] - values[:, k, j]
                stat = _stat(model, key, measure, condition, values[:, k, j], cells, below)
                if stat is not None:
                    yield stat


def _stat(
    model: str,
    key: Key,
    measure: str,
    condition: Condition | None,
    values: Values,
    cells: Numbers,
    below: Values | None,
) -> Stat | None:
    """Statistics of (n,) scores in percent, and of how much they are `below` the ceiling; None without a score."""
    summary = summarise(values, cells)
    if summary is None:
        return None
    span = summary.avg_interval
    rest = {"max": summary.max, "min": summary.min, "median": summary.median}
    rest |= _ends("median", summary.median_interval)
    if model == CEILING:
        own = average(values, cells)
        span, rest = None if own is None else own.interval, dict.fromkeys(rest)
    gap = None if below is None else average(below, cells)
    if gap is not None:
        rest |= {"below_ceiling": gap.mean} | _ends("below", gap.interval)
    numbers: dict[str, float | None] = {"avg": summary.avg} | _ends("avg", span) | rest
    place = dict.fromkeys(("depth_mm", "tilt_deg"))
    if condition is not None:
        place = {"depth_mm": condition.depth_mm, "tilt_deg": condition.tilt_deg}
    rounded = {name: None if value is None else _round(value) for name, value in numbers.items()}
    about = {"model": model, "alignment": key[0], "tone": key[1], "measure": measure, "n": summary.n}
    return Stat.model_validate(about | place | rounded)


def _ends(name: str, interval: tuple[float, float] | None) -> dict[str, float | None]:
    low, high = interval if interval is not None else (None, None)
    return {f"{name}_low": low, f"{name}_high": high}


def _models(outcome: Outcome) -> Iterator[ModelInfo]:
    """Yield every model that was compared, with what it knew of the presses of each session."""
    for name in outcome.scores.models:
        infos = [model.info for group in outcome.models.values() for model in group if model.name == name]
        if infos:
            yield infos[-1].model_copy(update={"basis": "; ".join(dict.fromkeys(info.basis for info in infos))})


def _session(session: FittedSession, scores: Scores) -> Session:
    calibration, fit = session.calibration, session.fit
    rows = [row for row in scores.rows if row.session == session.header.session_id]
    length, width = _ratios(session.header, rows)
    scale = None
    if calibration is not None:
        low, high = calibration.mm_per_px_low, calibration.mm_per_px_high
        scale = Scale(
            named=calibration.named, mm_per_px=calibration.mm_per_px, low=low, high=high, rms_px=calibration.rms_px
        )
    return Session(
        header=session.header,
        recording=session.recording.path.name,
        recording_sha256=session.sha256,
        strokes=len(session.strokes),
        compared=len(rows),
        cut=tuple(row.stroke.stroke_id for row in rows if row.cut),
        calibration=scale,
        fit=fit.digest if fit is not None else "",
        length_ratio=length,
        width_ratio=width,
        deepest_miss=_deepest_miss(rows),
        collected=collected_in(session.recording.path.parent),
    )


def _deepest_miss(rows: Sequence[Row]) -> DepthMiss | None:
    reached = [(row, row.stroke.reached_mm) for row in rows if row.stroke.reached_mm is not None]
    if not reached:
        return None
    row, reached_mm = max(reached, key=lambda pair: abs(pair[1] - pair[0].condition.depth_mm))
    depth_mm = row.condition.depth_mm
    return DepthMiss(stroke_id=row.stroke.stroke_id, depth_mm=depth_mm, reached_mm=round(reached_mm, 3))


def collected_in(folder: Path) -> Collected | None:
    """How the strokes of a folder were collected; None for a recording without a journal. Raises `SessionDamaged`."""
    if not (folder / JOURNAL_NAME).is_file():
        return None
    state = replay(folder / JOURNAL_NAME)
    captures, touches = state.results(CaptureResult), state.results(ZeroTouchResult)
    rejected = [capture for capture in captures if not capture.kept]
    skipped = [dip.skipped for dip in state.results(DipResult) if dip.skipped is not None]
    left_out = [*(capture.press for capture in rejected if not capture.retake), *skipped]
    heights_mm = [touch.touch_z_mm for touch in touches] or [0.0]
    return Collected(
        planned=details(folder).planned,
        photographed=len(captures),
        pressed_again=tuple(capture.press.stroke_id for capture in rejected if capture.retake),
        left_out=tuple(press.stroke_id for press in left_out),
        touches=tuple(f"{touch.method} {touch.touch_z_mm:.2f} mm" for touch in touches),
        moved_mm=_round(max(heights_mm) - min(heights_mm)),
    )


def _ratios(header: Header, rows: Sequence[Row]) -> tuple[float | None, float | None]:
    """Mean ratio of length and width of uncut marks to those of CCD-BSM for a brush of this size."""
    from brushloop.model.ccdbsm import ccdbsm

    brush = brush_of(header)
    ratios: list[tuple[float, float]] = []
    for row in rows:
        try:
            mark = ccdbsm(brush, row.condition.depth_mm, row.condition.tilt_deg)
        except DomainError:
            continue
        if not row.cut:
            measured = row.measured
            ratios.append(
                (measured.length_mm / float(mark.length_mm[0]), measured.breadth_mm / float(mark.width_mm[0]))
            )
    if not ratios:
        return None, None
    length, width = np.mean(ratios, axis=0)
    return _round(float(length)), _round(float(width))


def _round(value: float) -> float:
    """Round to six decimals; further digits would differ between machines."""
    return round(value, 6)
