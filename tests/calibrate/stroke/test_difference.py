"""The stroke that came between two photographs of one page."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.difference import new_stroke

DATA = Path(__file__).parents[4] / "shared" / "data" / "frida_page_sequence"
WORST_START_MM = 10.0
PX_PER_MM, PAGE_PX_PER_MM = 4.0, 2.7474


def page(*strokes: tuple[int, int, int, int], light: float = 1.0, shift: tuple[float, float] = (0, 0)) -> np.ndarray:
    """Ellipses (x, y, half length, half width) on a page with fibres, as uneven light shows it."""
    ink = np.full((400, 600), 1.0, np.float32)
    for x, y, a, b in strokes:
        cv2.ellipse(ink, (x, y), (a, b), 0, 0, 360, 0.15, -1)
    fibres = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 8, ink.shape).astype(np.float32), (0, 0), 2)
    slope = np.linspace(1.0, light, 600, dtype=np.float32)
    lit = cv2.GaussianBlur(225 * ink + fibres, (0, 0), 0.7) * slope
    moved = cv2.warpAffine(
        lit, np.array([[1.0, 0, shift[0]], [0, 1.0, shift[1]]]), (600, 400), borderMode=cv2.BORDER_REPLICATE
    )
    noisy = moved + np.random.default_rng(int(light * 1000)).normal(0, 1.5, ink.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


OLD = ((120, 100, 80, 20), (400, 90, 90, 18), (300, 320, 120, 25))
NEW = (180, 220, 90, 16)


@pytest.mark.parametrize(
    ("light", "shift"),
    [(1.0, (0, 0)), (0.85, (0, 0)), (1.0, (0.6, -0.4)), (1.0, (3.0, 2.0)), (0.85, (-6.0, 5.0))],
    ids=["still", "lamp", "moved", "moved by far", "lamp and moved by far"],
)
def test_the_new_stroke_is_found_and_nothing_else(light: float, shift: tuple[float, float]) -> None:
    truth = np.zeros((400, 600), np.uint8)
    cv2.ellipse(truth, NEW[:2], NEW[2:], 0, 0, 360, 1, -1)
    found = new_stroke(page(*OLD), page(*OLD, NEW, light=light, shift=shift), PX_PER_MM, "page")
    assert (found.mask & (truth > 0)).sum() / (found.mask | (truth > 0)).sum() > 0.995
    assert not any(flag.startswith(("crosses", "cut")) for flag in found.flags)
    said_px = [float(flag.split()[4]) for flag in found.flags if flag.startswith("moved: the page lay")]
    moved_px = math.hypot(*shift)
    assert said_px == ([pytest.approx(moved_px, abs=0.2)] if moved_px > 1.0 else [])


def test_what_lies_on_older_ink_is_said_to_be_hidden() -> None:
    found = new_stroke(page(*OLD), page(*OLD, (180, 110, 90, 16)), PX_PER_MM, "page")
    assert any(flag.startswith("crosses") for flag in found.flags)


def test_a_page_on_which_nothing_came_is_refused() -> None:
    with pytest.raises(CaptureRefused, match="no new stroke"):
        new_stroke(page(*OLD), page(*OLD, light=0.95), PX_PER_MM, "page")
    with pytest.raises(CaptureRefused, match="is 300 x 200 px"):
        new_stroke(page(), page()[:200, :300], PX_PER_MM, "page")


@pytest.mark.soak  # half a minute
@pytest.mark.skipif(not DATA.is_dir(), reason="the real page sequence is not here")
def test_on_a_real_page_every_stroke_is_found_where_it_should_begin() -> None:
    with (DATA / "strokes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    for row in rows:
        before, after = (cv2.imread(str(DATA / row[name]), 0) for name in ("before", "after"))
        start_px = float(row["start_x_px"]), float(row["start_y_px"])
        ys, xs = np.nonzero(new_stroke(before, after, PAGE_PX_PER_MM, row["after"], near_px=start_px).mask)
        assert np.hypot(xs - start_px[0], ys - start_px[1]).min() < WORST_START_MM * PAGE_PX_PER_MM, row["after"]
