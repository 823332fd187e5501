"""Each flaw shows by a measure of its own that knows nothing of how it was made."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest

from brushloop.drivers.sim.brush.brush import Brush, BrushSpec, Flaw
from brushloop.drivers.sim.brush.footprint import COHESIVE_LOAD, flaw_of_load, natural_split
from brushloop.drivers.sim.brush.paper import Footprint

SEVERITIES = (0.0, 0.25, 0.5, 0.75, 1.0)
CELLS = [(11.0, 0.0), (15.0, 5.0), (20.0, 10.0)]
SEEDS = range(4)


@pytest.fixture(scope="module")
def brush() -> Brush:
    return Brush(BrushSpec())


def flawed(brush: Brush, flaw: Flaw | None, severity: float = 1.0, *, cell=(15.0, 5.0), seed: int = 1) -> Footprint:
    return brush.press(*cell, ink_load=1.0, press_seed=seed, flaw=flaw, severity=severity)


def inked(mark: Footprint) -> np.ndarray:
    return mark.density > 0.3


def gap_mm(mark: Footprint) -> float:
    """Widest run of bare paper between ink of one column, in the half of the mark toward the tip."""
    ink = inked(mark)
    columns = np.flatnonzero(ink.any(axis=0))
    widest = 0
    for column in columns[: columns.size // 2]:
        rows = np.flatnonzero(ink[:, column])
        widest = max(widest, int(np.diff(rows).max(initial=1)) - 1)
    return widest / mark.px_per_mm


def aside_mm(mark: Footprint) -> float:
    """Distance of the tip third's centroid from the axis of the brush."""
    rows, columns = np.nonzero(inked(mark))
    third = columns < columns.min() + np.ptp(columns) / 3
    return abs(mark.origin_px[1] - rows[third].mean() - 0.5) / mark.px_per_mm


def cover(mark: Footprint, sound: Footprint) -> float:
    """Share of the outline of a sound press of the same seed that carries ink; frames differ, origins do not."""
    placed = np.zeros(sound.density.shape, bool)
    dx, dy = (int(a - b) for a, b in zip(sound.origin_px, mark.origin_px, strict=True))
    rows, columns = np.nonzero(inked(mark))
    rows, columns = rows + dy, columns + dx
    kept = (rows >= 0) & (columns >= 0) & (rows < placed.shape[0]) & (columns < placed.shape[1])
    placed[rows[kept], columns[kept]] = True
    outline = inked(sound)
    return (placed & outline).sum() / outline.sum()


def grows(series: list[float], least: float = 0.0) -> bool:
    return all(b - a >= least for a, b in itertools.pairwise(series))


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_split_opens_toward_the_tip(brush: Brush, cell, seed: int):
    assert gap_mm(flawed(brush, None, cell=cell, seed=seed)) < 0.3
    mark = flawed(brush, Flaw.SPLIT, cell=cell, seed=seed)
    assert gap_mm(mark) > 1.0
    ink = inked(mark).astype(np.uint8)
    columns = np.flatnonzero(ink.any(axis=0))
    prongs, _ = cv2.connectedComponents(np.ascontiguousarray(ink[:, : columns[0] + columns.size // 4]))
    whole, _ = cv2.connectedComponents(ink)
    assert (prongs - 1, whole - 1) == (2, 1), "two tips, one heel"


def test_a_worse_split_is_a_wider_gap(brush: Brush):
    assert grows([np.mean([gap_mm(flawed(brush, Flaw.SPLIT, s, seed=n)) for n in SEEDS]) for s in SEVERITIES], 0.1)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_bent_tip_lies_off_the_axis(brush: Brush, cell, seed: int):
    assert aside_mm(flawed(brush, None, cell=cell, seed=seed)) < 0.5
    assert aside_mm(flawed(brush, Flaw.BENT, cell=cell, seed=seed)) > 1.0


def test_a_worse_bend_lies_farther_off_and_either_side_occurs(brush: Brush):
    assert grows([np.mean([aside_mm(flawed(brush, Flaw.BENT, s, seed=n)) for n in SEEDS]) for s in SEVERITIES], 0.1)
    middles = [
        np.nonzero(inked(m))[0].mean() - m.origin_px[1] for m in (flawed(brush, Flaw.BENT, seed=n) for n in range(8))
    ]
    assert min(middles) < 0 < max(middles)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("seed", SEEDS)
def test_a_dry_brush_inks_less_than_its_outline(brush: Brush, cell, seed: int):
    assert cover(flawed(brush, Flaw.DRY, cell=cell, seed=seed), flawed(brush, None, cell=cell, seed=seed)) < 0.6


def test_a_drier_brush_inks_less(brush: Brush):
    sound = {n: flawed(brush, None, seed=n) for n in SEEDS}
    covers = [-np.mean([cover(flawed(brush, Flaw.DRY, s, seed=n), sound[n]) for n in SEEDS]) for s in SEVERITIES]
    assert grows(covers, 1e-3)


@pytest.mark.parametrize("severity", [0.1, 1.0])
def test_a_blank_press_leaves_nothing(brush: Brush, severity: float):
    mark = flawed(brush, Flaw.BLANK, severity)
    assert not mark.density.any()


def test_a_faint_mark_keeps_its_outline_and_loses_its_tone(brush: Brush):
    marks = [flawed(brush, Flaw.FAINT, s) for s in SEVERITIES]
    assert grows([-float(m.density.max()) for m in marks], 0.1)
    areas = [np.count_nonzero(m.density > 0.5 * m.density.max()) for m in marks]
    assert areas == pytest.approx([areas[0]] * len(areas), rel=0.01)
    assert marks[-1].density.max() < 0.3


@pytest.mark.parametrize("flaw", list(Flaw))
def test_a_flaw_is_the_same_for_the_same_seed_and_severity_0_is_none(brush: Brush, flaw: Flaw):
    again = Brush(BrushSpec())
    assert flawed(brush, flaw, 0.7).density.tobytes() == flawed(again, flaw, 0.7).density.tobytes()
    assert flawed(brush, flaw, 0.0).density.tobytes() == flawed(brush, None).density.tobytes()
    if flaw is not Flaw.BLANK:
        assert flawed(brush, flaw, 0.7, seed=2).density.tobytes() != flawed(brush, flaw, 0.7).density.tobytes()


def test_a_severity_out_of_range_is_refused(brush: Brush):
    with pytest.raises(ValueError, match=r"severity = 1\.5 is outside 0 \.\. 1"):
        flawed(brush, Flaw.SPLIT, 1.5)


def test_an_emptying_brush_leaves_faint_then_dry_then_blank_marks(brush: Brush):
    loads = [1.0 - 0.12 * n for n in range(9)]
    named = [flaw_of_load(load) for load in [*loads, 0.0]]
    assert [flaw for flaw, _ in itertools.groupby(named)] == [None, Flaw.FAINT, Flaw.DRY, Flaw.BLANK]

    def seen(load: float) -> tuple[float, float]:
        """(tone, share of the outline inked), as a share of the fresh brush's."""
        mark, fresh = (brush.press(15, 5, ink_load=v, press_seed=1) for v in (load, 1.0))
        tone = np.median(mark.density[inked(mark)]) / np.median(fresh.density[inked(fresh)])
        return float(tone), cover(mark, fresh)

    for load, flaw in zip(loads, named, strict=False):
        tone, share = seen(load)
        assert (tone < 0.75) == (flaw is not None), (load, tone)
        assert (share < 0.7) == (flaw is Flaw.DRY), (load, share)


def test_a_brush_splits_by_itself_the_more_often_the_emptier_it_is():
    def chance(load: float, depth_mm: float = 15.0) -> float:
        return float(np.mean([natural_split(load, depth_mm, np.random.default_rng(n)) > 0.0 for n in range(400)]))

    assert chance(1.0) == chance(COHESIVE_LOAD) == 0.0
    assert grows([chance(load) for load in (0.64, 0.4, 0.16)], 0.05)
    assert chance(0.1, depth_mm=1.0) == 0.0
    assert chance(0.0) == 0.0, "nothing shows"
