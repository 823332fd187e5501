"""Blur, glare, light and frame on made-up pictures, where the right answer is known; captures of the loopback brush,
each failure called by its name; and real photographs, where they are: what their ink is called."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from bench.brushes import DATA as SHARED
from bench.quality import SPOTLESS_MM2, Bench, Sample, score
from brushloop.calibrate.board.pix2len import Plane
from brushloop.calibrate.stroke.preprocess import PX_PER_MM
from brushloop.collect.photograph.checks import Failure, Photograph, Verdict
from brushloop.collect.photograph.measure import Ink, Window, blur_px, glare, measure_mark, paper_level
from brushloop.collect.rig.config import QualityConfig
from brushloop.collect.rig.paper import Patch
from tests.calibrate.given import flat_plane

LIMITS = QualityConfig()
PX = 8.0
PATCH = Patch(0, 20.0, 15.0, 40.0, 24.0)
Gray = NDArray[np.uint8]


def plane(height_px: int = 480) -> Plane:
    """8 px/mm, the paper's lower left corner at the picture's."""
    step = 1.0 / PX
    return flat_plane((640, height_px), (step, step))


def paper(*, seed: int = 0) -> Gray:
    noise = np.random.default_rng(seed).normal(0.0, 1.5, (480, 640))
    return np.clip(200.0 + noise, 0.0, 255.0).astype(np.uint8)


def of(image: Gray, **more: Any) -> Photograph:
    return Photograph(image, plane(), LIMITS, **more)


def stroke(image: Gray, x_mm: float, y_mm: float, length_mm: float = 18.0, level: int = 20) -> Gray:
    """A lens-shaped mark that ends at (x, y) and runs toward -x."""
    middle = (round((x_mm - length_mm / 2) * PX), round(480 - y_mm * PX))
    cv2.ellipse(image, middle, (round(length_mm / 2 * PX), round(3.0 * PX)), 0.0, 0.0, 360.0, level, -1, cv2.LINE_AA)
    return image


@given(sigma=st.floats(0.8, 4.0), contrast=st.integers(80, 200))
@settings(max_examples=15)
def test_blur_is_measured_whatever_the_contrast_of_the_ink(sigma: float, contrast: int) -> None:
    sharp = np.full((400, 400), 220, np.uint8)
    sharp[:, 200:] -= np.uint8(contrast)
    sharp[:200, :100] -= np.uint8(contrast)
    blurred = cv2.GaussianBlur(sharp.astype(np.float32), (0, 0), sigma)
    found = blur_px(np.rint(blurred).astype(np.uint8))
    assert found is not None
    assert found == pytest.approx(sigma, abs=0.1 + 0.1 * sigma)


def test_a_shake_along_one_direction_counts_as_blur_and_a_bare_sheet_has_none() -> None:
    image = stroke(stroke(paper(), 40.0, 20.0), 60.0, 40.0)
    sharp, dragged = blur_px(image), blur_px(cv2.blur(image, (15, 1)).astype(np.uint8))
    assert sharp is not None
    assert dragged is not None
    assert dragged > 3.0 * sharp
    assert blur_px(paper()) is None
    assert of(paper()).check_frame().passed


def test_exposure_is_described_in_words() -> None:
    assert paper_level(paper()) == pytest.approx(200.0, abs=2.0)
    for gain, word in ((0.2, "too dark"), (1.6, "too bright")):
        verdict = of(np.clip(stroke(paper(), 50.0, 27.0) * gain, 0.0, 255.0).astype(np.uint8)).check_frame()
        assert named(verdict) == "exposure"
        assert word in verdict.reason


def test_a_lamp_is_glare_and_neither_the_edge_of_a_shadow_nor_bare_paper_between_wide_marks() -> None:
    y, x = np.mgrid[0:480, 0:640]
    lamp = paper() + 80.0 * np.exp(-0.5 * ((x - 320.0) ** 2 + (y - 240.0) ** 2) / 50.0**2)
    assert glare(np.clip(lamp, 0, 255).astype(np.uint8), 0.1).any()
    shadow = paper() * np.where(x > 330, 0.7, 1.0)
    assert not glare(np.asarray(shadow, np.uint8), 0.1).any()
    px = 10  # the scale at which glare is looked for
    for width_mm in (8.0, 12.0, 16.0, 20.0):
        image = np.full((68 * px, 84 * px), 200, np.uint8)
        for x_mm, y_mm in [(22, 10), (62, 10), (22, 34), (62, 34), (22, 58), (62, 58)]:
            cv2.ellipse(image, (x_mm * px, y_mm * px), (14 * px, round(0.5 * width_mm * px)), 0, 0, 360, 20, -1)
        assert not glare(image, 0.1).any(), width_mm


def press(image: Gray, depth_mm: float = 14.0, patch: Patch = PATCH, **more: Any) -> Verdict:
    return of(image, **more).check_press(patch, depth_mm)


def named(verdict: Verdict, among: Sequence[Failure] = tuple(Failure)) -> str:
    """The first failure among those asked for, in a word."""
    failed = [check.name for check in verdict.checks if not check.passed and check.name in among]
    return str(failed[0]) if failed else "sound"


def score_of(verdict: Verdict) -> float:
    """Of the check that failed first."""
    assert verdict.cause is not None
    assert verdict.cause.score is not None
    return verdict.cause.score


def test_a_sound_mark_passes_and_its_place_is_measured() -> None:
    x_mm, y_mm = PATCH.anchor_mm
    assert press(stroke(paper(), x_mm + 0.7, y_mm), previous=paper(seed=1)).passed
    moved = press(stroke(paper(), x_mm + 0.7, y_mm + 3.0), previous=paper(seed=1))
    assert (named(moved), score_of(moved)) == ("misplaced", pytest.approx(3.0, abs=0.2))
    other_way = stroke(paper(), x_mm - 0.7 + 9.0, y_mm, length_mm=9.0)
    assert press(other_way, 11.0).passed, "a brush that lies down the other way is sound too"


def test_a_press_in_another_patch_is_misplaced_and_not_blank_where_the_still_before_is_known() -> None:
    before = stroke(paper(seed=1), 50.0, 8.0)
    image = stroke(stroke(paper(), 50.0, 8.0), 50.0, 48.0)
    verdict = press(image, previous=before, sheet_mm=(80.0, 60.0))
    assert (named(verdict), score_of(verdict)) == ("misplaced", pytest.approx(18.0, abs=1.0))
    assert named(press(image, sheet_mm=(80.0, 60.0))) == "blank"


def test_a_mark_at_the_edge_of_the_frame_is_cut_and_nothing_else_is_said_of_it() -> None:
    patch = Patch(3, -22.0, 15.0, 40.0, 24.0)
    verdict = press(stroke(paper(), patch.anchor_mm[0] + 0.7, patch.anchor_mm[1]), patch=patch)
    assert named(verdict) == "cut"
    assert all(Failure(check.name).of_picture for check in verdict.checks)


def test_a_figure_is_sound_where_its_patch_has_new_ink_and_blank_where_it_has_none() -> None:
    before = stroke(paper(seed=1), 50.0, 27.0)
    drawn = stroke(stroke(paper(), 50.0, 27.0), 52.0, 22.0)

    def judge(image: Gray, previous: Gray | None = None) -> Verdict:
        return of(image, previous=previous).check_drawing(PATCH, 5.0)

    assert judge(drawn, previous=before).passed
    assert named(judge(stroke(paper(), 50.0, 27.0), previous=before)) == "blank"
    assert judge(paper()).cause == judge(paper(), previous=paper(seed=1)).cause
    arm = drawn.copy()
    cv2.circle(arm, (420, 260), 90, 60, -1)  # over the right edge of the patch
    assert named(judge(arm, previous=before)) == "neighbour"
    assert named(judge(np.asarray(drawn * 0.2, np.uint8))) == "exposure"


def test_a_patch_that_is_not_wholly_seen_is_not_called_blank() -> None:
    hidden = of(paper()).check_blank(Patch(3, -10.0, 15.0, 40.0, 24.0))
    assert "not completely in the picture" in hidden.reason
    inked = stroke(paper(), 50.0, 27.0)
    assert "Patch 0 is not blank" in of(inked).check_blank(PATCH).reason
    lax = LIMITS.model_copy(update={"foreign_mm2": 900.0})
    assert Photograph(inked, plane(), lax).check_blank(PATCH).passed
    assert of(paper()).check_blank(PATCH).passed


def test_the_edge_of_a_sheet_is_no_ink_in_the_patches_along_it() -> None:
    patch, sheet_mm = Patch(0, 20.0, 36.0, 40.0, 24.0), (80.0, 60.0)
    seen = paper()
    seen[: round(0.8 * PX)] = 20  # the dark table, where the sheet was thought to reach
    assert not of(seen).check_blank(patch).passed
    assert of(seen, sheet_mm=sheet_mm).check_blank(patch).passed
    first = press(stroke(seen.copy(), 50.0, 48.0), 10.0, patch, sheet_mm=sheet_mm)
    assert next(check for check in first.checks if check.name == Failure.NEIGHBOUR).passed


@pytest.mark.parametrize("photo_px_per_mm", [6.25, 3.3, 2.5])
def test_an_even_mark_is_even_at_any_resolution(photo_px_per_mm: float) -> None:
    """A coarse photograph blurs the edge of a mark over more of it: a sound mark is not called dry for that."""
    # An ellipse of 24 x 8 mm in a window of 30 x 14 mm.
    sharp = np.zeros((round(14 * PX_PER_MM), round(30 * PX_PER_MM)), np.float32)
    half = round(12 * PX_PER_MM), round(4 * PX_PER_MM)
    cv2.ellipse(sharp, (sharp.shape[1] // 2, sharp.shape[0] // 2), half, 0.0, 0.0, 360.0, 0.85, cv2.FILLED)
    share = photo_px_per_mm / PX_PER_MM
    photo = cv2.GaussianBlur(cv2.resize(sharp, None, fx=share, fy=share, interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    dark = np.asarray(cv2.resize(photo, sharp.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    window = Window((0.0, 0.0, 30.0, 14.0), dark, np.ones(dark.shape, np.bool_), 1.0 / photo_px_per_mm)
    mark = measure_mark(Ink(window, dark > 0.2, 0.0, 0.0), (20.0, 7.0))
    assert mark is not None
    assert mark.uneven < 0.25 * LIMITS.uneven


# Captures of the loopback brush, each with what it is; drawn once

SOUND = 5
drawn_once = pytest.mark.xdist_group("quality")


@pytest.fixture(scope="module")
def drawn() -> list[Sample]:
    """Every failure once, and some sound strokes."""
    wanted: list[Failure | None] = [*Failure, *[None] * SOUND]
    samples: list[Sample] = []
    for sheet in itertools.count():
        bench = Bench(41, sheet)
        for patch in map(bench.sheet.patch, range(bench.sheet.capacity)):
            if not wanted:
                return samples
            if bench.ink_mm2(patch) <= SPOTLESS_MM2 and (sample := bench.capture(patch, wanted[0])) is not None:
                samples.append(sample)
                if sample.label is wanted[0]:
                    del wanted[0]
    raise AssertionError


@drawn_once
def test_each_failure_is_called_by_its_name_and_a_sound_stroke_is_left_alone(drawn: list[Sample]) -> None:
    scores = score(drawn, LIMITS)
    assert {label: scores.confused(label) for label in (None, *Failure) if scores.recall(label) < 1.0} == {}


@drawn_once
def test_without_a_still_from_before_the_stroke_itself_is_judged_the_same(drawn: list[Sample]) -> None:
    bristles = {None, Failure.DRY, Failure.FAINT, Failure.SPLIT, Failure.BENT, Failure.BLANK}
    scores = score([s for s in drawn if s.label in bristles], LIMITS, with_previous=False)
    assert {label: scores.confused(label) for label in bristles if scores.recall(label) < 1.0} == {}


@drawn_once
def test_a_verdict_shows_the_operator_what_was_seen_and_what_to_do_by_the_limits_of_the_configuration(
    drawn: list[Sample],
) -> None:
    def judged(label: Failure | None, limits: QualityConfig = LIMITS) -> Verdict:
        sample = next(s for s in drawn if s.label is label)
        photograph = Photograph(sample.image, sample.plane, limits, previous=sample.before)
        return photograph.check_press(sample.patch, sample.depth_mm)

    verdict = judged(Failure.SPLIT)
    assert verdict.cause is not None
    assert verdict.cause.threshold == LIMITS.split_mm
    assert (verdict.cause.score or 0.0) > LIMITS.split_mm
    assert "mm. Comb the brush" in verdict.reason
    [faint] = [check for check in verdict.checks if check.name == Failure.FAINT]
    assert (faint.passed, faint.reason) == (True, "")
    assert named(judged(None, LIMITS.model_copy(update={"faint_tone": 0.99}))) == Failure.FAINT


# Real photographs. They are drags, and nothing was tuned to them

DATA = SHARED / "frida_bigbrush_tilt_16x20"
WHITENED = QualityConfig(bright_level=256.0, glare_mm2=1e6)
"""For paper that whoever published it has set to 255: neither exposure nor glare can be judged."""
INK = (Failure.NEIGHBOUR, Failure.BLANK, Failure.DRY, Failure.FAINT)
"""What can be asked of a drag: its place and its shape are not those of a press."""
BLANK = "png/120.png"


@dataclass(frozen=True)
class Page(Patch):
    """A photograph as a whole, and where the brush touched it."""

    start_mm: tuple[float, float]

    @property
    def anchor_mm(self) -> tuple[float, float]:
        return self.start_mm


def judge(row: dict[str, str], limits: QualityConfig = WHITENED) -> Verdict:
    """The verdict on one photograph as a whole, as if it were a patch."""
    image = cv2.imread(str(DATA / row["file"]), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    x_mm, y_mm = 1.0 / float(row["px_per_mm_x"]), 1.0 / float(row["px_per_mm_y"])
    size_mm = image.shape[1] * x_mm, image.shape[0] * y_mm
    photograph = Photograph(image.astype(np.uint8), flat_plane(image.shape[::-1], (x_mm, y_mm)), limits, size_mm)
    depth_mm = max(float(row.get("depth_mid_mm_nominal") or 9.0), 1.0)  # 9 mm where the table has none
    start_mm = float(row["start_x_px"]) * x_mm, size_mm[1] - float(row["start_y_px"]) * y_mm
    return photograph.check_press(Page(0, 0.0, 0.0, *size_mm, start_mm), depth_mm)


@pytest.mark.skipif(not DATA.is_dir(), reason="the folder of real photographs is not here")
def test_the_ink_of_most_real_strokes_is_called_sound_and_none_but_the_blank_photograph_blank() -> None:
    with (DATA / "strokes.csv").open() as file:
        rows = list(csv.DictReader(file))
    [blank] = [row for row in rows if row["file"] == BLANK]
    assert named(judge(blank)) == "blank"
    called = Counter(named(judge(row), INK) for row in rows[::24] if row["file"] != BLANK)
    assert called["blank"] == 0
    assert called["sound"] > 0.5 * called.total(), called
    assert named(judge(rows[0], QualityConfig())) == "exposure", "a whitened photograph, unless the limit is lifted"
