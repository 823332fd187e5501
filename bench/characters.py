"""Characters written by simulated brushes without a rig: what a plan reaches unlearned, and after each round.

Planning, fitting and learning are those of `brushloop write --practice --learn 3`. Only the writing is short: strokes
go straight to the simulated brush, and its ink straight to the 128 x 128 cell, without arm, paper plane, camera or
calibration between. `bench written` writes the same with all of them, and takes ten times as long.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.brushfit_brushes import FROZEN
from bench.harness import Result, machine
from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.field import SIZE_PX, Alignment, Tone
from brushloop.calibrate.compare.similarity import Polarity
from brushloop.calibrate.writing.compare import WritingComparison, as_ink
from brushloop.calibrate.writing.footprint import PER_FIGURE, practice_strokes
from brushloop.calibrate.writing.learn import learned, lost_in_words, round_of
from brushloop.calibrate.writing.plan import Settings, plan
from brushloop.calibrate.writing.plan_files import record_of
from brushloop.calibrate.writing.plan_record import FigureRecord, PlannedBy, PlanRecord, arrays
from brushloop.calibrate.writing.scores import HEADLINE, Character, compare_ink
from brushloop.drivers.sim.brush.brush import Brush, BrushSpec
from brushloop.drivers.sim.brush.drag import Waypoint
from brushloop.drivers.sim.brush_file import PAPER, load_brush
from brushloop.model.brush import Brush as Size
from brushloop.model.characters.brush import Reach
from brushloop.model.characters.plan import grid, without_tilt
from brushloop.model.footprint import Footprint, fit_footprint
from brushloop.model.strokes import stroke_model
from brushloop.sessions.records import Header, Source

Floats = NDArray[np.float64]
CHARACTERS, ROUNDS, WRITINGS, IN_A_ROUND = "字子永", 3, 10, 2
SIDE_MM, PX_PER_MM = 70.0, 10.0
INK_ABOVE = 0.4
"""Density that counts as ink, about where a photograph's threshold lies."""
PAPER_POLARITY = (Alignment.MM, Tone.BINARY, Polarity.PAPER)


def run(*, n: int | None = None, seed: int = 1) -> Sequence[Result]:
    """CSIM against the font for the paper's brush and the five frozen ones, each character; the first `n` brushes.

    value = average in percent over ten writings after at most three rounds (mm, binary, ink = 1); ratio = 100 less the
    unlearned CSIM over 100 less the learned one; about a minute a brush on a quiet core. `seed` is that of the ink.
    """
    brushes = [("the paper's", load_brush(Path(PAPER)).spec)]
    brushes += [(f"frozen {number}", spec) for number, spec in enumerate(FROZEN, 1)]
    if n is not None and not 1 <= n <= len(brushes):
        raise ValueError(f"n = {n}: 1 to {len(brushes)} brushes")
    return [result for name, spec in brushes[:n] for result in _of_brush(name, spec, seed)]


def _of_brush(name: str, spec: BrushSpec, seed: int) -> list[Result]:
    writer = Writer(spec, seed)
    record = _planned(spec, writer.footprint())
    rounds: list[dict[str, float]] = []
    for number in range(ROUNDS):
        written = [writer.character(figure, number, IN_A_ROUND) for figure in record.figures]
        rounds.append({one.name: _average(one, HEADLINE)[0] for one in written})
        record, _ = learned(_comparison(record, written))
        if all(figure.settled for figure in record.figures):
            break
    return [
        _result(name, figure, writer.character(figure, ROUNDS, WRITINGS), rounds, seed) for figure in record.figures
    ]


class Writer:
    """A simulated brush that writes on cells; a seed of its own for every stroke."""

    def __init__(self, spec: BrushSpec, seed: int) -> None:
        self._brush = Brush(spec)
        self._next = 1_000_003 * seed

    def footprint(self) -> Footprint:
        """The footprint fitted to a practice sheet."""
        strokes = practice_strokes(SIDE_MM, Reach(), self._brush.spec.length_mm)
        firsts = range(0, len(strokes), PER_FIGURE)
        ink = np.stack([self.ink(strokes[first : first + PER_FIGURE]) for first in firsts])
        paths = [without_tilt(stroke) for stroke in strokes]
        return fit_footprint(paths, np.array([*firsts, len(strokes)]), ink, *grid(SIDE_MM, SIZE_PX))

    def character(self, figure: FigureRecord, number: int, count: int) -> Character:
        """A character written `count` times in round `number`."""
        strokes = arrays(figure.commanded)
        ink = {f"{figure.name}-{number}-r{k:02d}": as_ink(self.ink(strokes)) for k in range(1, count + 1)}
        return Character(figure.name, figure.source, as_ink(figure.wanted()), as_ink(figure.simulated()), ink)

    def ink(self, strokes: Sequence[Floats]) -> NDArray[np.float32]:
        """(128, 128) coverage of a cell by strokes, (N, 5) each; the brush is dipped before each stroke."""
        size = round(SIDE_MM * PX_PER_MM)
        cell = np.zeros((size, size), np.float32)
        for stroke in strokes:
            self._lay(cell, stroke)
        covered = (cell > INK_ABOVE).astype(np.float32)
        return np.asarray(cv2.resize(covered, (SIZE_PX, SIZE_PX), interpolation=cv2.INTER_AREA), np.float32)

    def _lay(self, cell: NDArray[np.float32], stroke: Floats) -> None:
        self._next += 1
        (x, y, *_), (end_x, end_y, *_) = stroke[0], stroke[-1]
        path = [Waypoint(x, y, 0.0), *(Waypoint(*point[:3]) for point in stroke), Waypoint(end_x, end_y, 0.0)]
        tilt_deg = float(stroke[np.argmax(stroke[:, 2]), 3])
        mark = self._brush.drag(
            path, tilt_deg, float(stroke[0, 4]), ink_load=1.0, press_seed=self._next, px_per_mm=PX_PER_MM
        )
        left = round(x * PX_PER_MM - mark.origin_px[0])
        top = round((SIDE_MM - y) * PX_PER_MM - mark.origin_px[1])
        height, width = mark.density.shape
        rows, columns = (slice(max(0, at), max(0, at + long)) for at, long in ((top, height), (left, width)))
        part = cell[rows, columns]
        shown = mark.density[rows.start - top :, columns.start - left :][: part.shape[0], : part.shape[1]]
        np.maximum(part, shown, out=part)


def _planned(spec: BrushSpec, footprint: Footprint) -> PlanRecord:
    reach = Reach()
    model = stroke_model("ccd-bsm", Size(spec.radius_mm, spec.length_mm), math.pi)
    figures = plan(CHARACTERS, None, model, Settings(footprint=footprint))
    by = PlannedBy(
        model="ccd-bsm",
        radius_mm=spec.radius_mm,
        length_mm=spec.length_mm,
        lam=None,
        depth_range_mm=reach.depth_mm,
        tilt_range_deg=reach.tilt_deg,
        turn_deg_mm=reach.turn_deg_mm,
        speed_mm_s=15.0,
        footprint=footprint.values,
    )
    return PlanRecord(
        model="footprint", planned_by=by, cell_mm=SIDE_MM, software="bench", figures=tuple(map(record_of, figures))
    )


def _comparison(record: PlanRecord, written: list[Character]) -> WritingComparison:
    header = Header(session_id="bench", source=Source.LOOPBACK, software="bench")
    return WritingComparison(header, Path("bench"), "", Calibration.model_construct(), record, written, [], [])


def _average(one: Character, key: tuple[Alignment, Tone, Polarity]) -> tuple[float, float]:
    scores = [compare_ink(one.reference, ink, key) for ink in one.captured.values()]
    csim, ssim = 100.0 * np.mean(scores, axis=0)
    return float(csim), float(ssim)


def _repeated(one: Character, key: tuple[Alignment, Tone, Polarity]) -> str:
    """How nearly neighbouring writings of one plan agree."""
    pairs = itertools.pairwise(one.captured.values())
    csim, ssim = 100.0 * np.mean([compare_ink(a, b, key) for a, b in pairs], axis=0)
    return f"{csim:.2f} / {ssim:.2f}"


def _result(name: str, figure: FigureRecord, one: Character, rounds: list[dict[str, float]], seed: int) -> Result:
    csim, ssim = _average(one, HEADLINE)
    paper_csim, paper_ssim = _average(one, PAPER_POLARITY)
    again = " and ".join(_repeated(one, key) for key in (HEADLINE, PAPER_POLARITY))
    unlearned = rounds[0][one.name]
    each = [100.0 * compare_ink(one.reference, ink, HEADLINE)[0] for ink in one.captured.values()]
    conditions = (
        f"simulated brush {name}, written directly, {one.name}, {len(each)} writings; rounds "
        f"{' '.join(f'{found[one.name]:.1f}' for found in rounds)}; CSIM {csim:.1f} and SSIM {ssim:.1f} (mm, ink = 1), "
        f"{paper_csim:.2f} and {paper_ssim:.2f} (paper = 1); two writings agree to "
        f"{again} (CSIM / SSIM); first writing {each[0]:.1f}, tenth {each[-1]:.1f}; most "
        f"lost in {lost_in_words([round_of(figure, one, SIDE_MM)])}; {machine()}"
    )
    ratio = (100.0 - unlearned) / (100.0 - csim) if csim < 100.0 else float("inf")
    return Result(
        f"characters: {name}, {one.name}", csim, "% CSIM", "the unlearned shortfall", ratio, len(each), seed, conditions
    )
