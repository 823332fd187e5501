"""A small set of captures with a label, every failure at least twice: each must be called by its name."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import pytest

from bench.quality import SPOTLESS_MM2, Bench, Blank, Sample, Score, score
from brushloop.collect.photograph.checks import Failure, Photograph, Verdict
from brushloop.collect.rig.config import QualityConfig

pytestmark = pytest.mark.xdist_group("quality")  # drawn once
EACH, SOUND = 2, 10
LIMITS = QualityConfig()


def draw() -> Iterator[Sample | Blank]:
    wanted: list[Failure | None] = [*itertools.chain(*[Failure] * EACH), *[None] * SOUND]
    for sheet in itertools.count():
        bench = Bench(41, sheet)
        for index in range(bench.sheet.capacity):
            patch = bench.sheet.patch(index)
            if not wanted:
                return
            there_mm2 = bench.ink_mm2(patch)
            if there_mm2 > SPOTLESS_MM2:
                continue
            yield Blank(True, bench.still, bench.plane, patch)
            sample = bench.capture(patch, wanted[0])
            if sample is None:
                continue
            if sample.label is wanted[0]:
                del wanted[0]
            yield sample
            if sample.label is None:
                yield Blank(False, bench.still, bench.plane, patch)


@pytest.fixture(scope="module")
def drawn() -> list[Sample | Blank]:
    return list(draw())


@pytest.fixture(scope="module")
def scores(drawn: list[Sample | Blank]) -> Score:
    return score(drawn, LIMITS)


@pytest.mark.parametrize("failure", list(Failure))
def test_a_failure_is_called_by_its_name(scores: Score, failure: Failure) -> None:
    assert scores.of(failure) >= EACH
    assert scores.recall(failure) == 1.0, scores.confused(failure)
    assert scores.precision(failure) >= 0.66


def test_a_sound_stroke_is_left_alone(scores: Score) -> None:
    assert scores.of(None) >= SOUND
    assert scores.false_alarms == 0.0, scores.confused(None)


def test_a_patch_is_called_blank_only_where_it_is(scores: Score) -> None:
    assert scores.blanks_seen[True, False] == 0
    assert scores.blanks_seen[False, True] == 0
    assert scores.blanks_seen[False, False] >= SOUND


def test_without_a_still_from_before_the_stroke_itself_is_judged_the_same(drawn: list[Sample | Blank]) -> None:
    bristles = {None, Failure.DRY, Failure.FAINT, Failure.SPLIT, Failure.BENT, Failure.BLANK}
    scores = score([s for s in drawn if isinstance(s, Sample) and s.label in bristles], LIMITS, with_previous=False)
    assert scores.false_alarms == 0.0
    assert sum(scores.counts[label, label] for label in bristles) >= len(scores.seconds) - 1


def judged(sample: Sample, limits: QualityConfig) -> Verdict:
    photograph = Photograph(sample.image, sample.plane, limits, previous=sample.before)
    return photograph.check_press(sample.patch, sample.depth_mm)


def test_a_verdict_shows_the_operator_what_was_seen_and_what_to_do(drawn: list[Sample | Blank]) -> None:
    verdict = judged(next(s for s in drawn if isinstance(s, Sample) and s.label is Failure.SPLIT), LIMITS)
    assert verdict.cause is not None
    assert verdict.cause.threshold == LIMITS.split_mm
    assert (verdict.cause.score or 0.0) > LIMITS.split_mm
    assert "mm. Comb the brush" in verdict.reason
    [faint] = [check for check in verdict.checks if check.name == Failure.FAINT]
    assert (faint.passed, faint.reason) == (True, "")


def test_limits_come_from_the_configuration(drawn: list[Sample | Blank]) -> None:
    sound = next(s for s in drawn if isinstance(s, Sample) and s.label is None)
    verdict = judged(sound, LIMITS.model_copy(update={"faint_tone": 0.99}))
    assert verdict.cause is not None
    assert verdict.cause.name == Failure.FAINT
    inked = next(p for p in drawn if isinstance(p, Blank) and not p.blank)
    lax = LIMITS.model_copy(update={"foreign_mm2": 900.0})
    assert Photograph(inked.image, inked.plane, lax).check_blank(inked.patch).passed
