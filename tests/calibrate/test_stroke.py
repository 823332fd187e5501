"""From photographs to strokes, on pages whose ink is known to the pixel, and a real one."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.stroke.difference import new_stroke
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, measure, prepare, rectify, rescale
from tests.calibrate.given import iou, rows_of

PAGE = (800, 800)


def stroke(length_mm: float = 20.0, width_mm: float = 8.0, centre: tuple[int, int] = (400, 400)) -> np.ndarray:
    mask = np.zeros(PAGE, np.uint8)
    axes = (round(length_mm * PX_PER_MM / 2), round(width_mm * PX_PER_MM / 2))
    cv2.ellipse(mask, centre, axes, 0, 0, 360, 1, -1)
    return mask > 0


def page(mask: np.ndarray, *, shade: float = 0.0, ink: float = 0.1, noise: float = 2.0) -> np.ndarray:
    light = 230.0 * (1.0 - shade * np.linspace(0, 1, PAGE[1])[None, :] * np.ones((PAGE[0], 1)))
    image = light * np.where(mask, ink, 1.0) + np.random.default_rng(0).normal(0, noise, PAGE)
    return np.clip(cv2.GaussianBlur(image, (0, 0), 1.0), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("shade", "length_mm", "width_mm"), [(0.0, 20.0, 8.0), (0.6, 20.0, 8.0), (0.0, 34.0, 20.0)])
def test_the_stroke_is_found_whatever_the_light_does(shade: float, length_mm: float, width_mm: float) -> None:
    """A thick stroke is not taken for shadow."""
    truth = stroke(length_mm, width_mm)
    prepared = prepare(page(truth, shade=shade), None, "page")
    assert iou(prepared.mask, truth) > 0.98
    assert prepared.soft[380:420, 380:420].mean() > 0.95
    assert prepared.soft[:100].max() == 0.0


@pytest.mark.parametrize("shade", [0.0, 0.5])
def test_a_blank_page_is_refused_where_otsu_would_call_paper_ink(shade: float) -> None:
    with pytest.raises(CaptureRefused, match=r"capture 7: is blank"):
        prepare(page(np.zeros(PAGE, np.bool_), shade=shade), None, "capture 7")


def test_of_what_lies_on_the_page_the_stroke_is_kept() -> None:
    truth, dirty = stroke(), stroke()
    dirty |= stroke(6.0, 4.0, (90, 120))  # a neighbour's end
    dirty[700:704, 500:504] = True  # a speck
    assert iou(prepare(page(dirty), None, "page").mask, truth) > 0.98
    broken = truth.copy()
    broken[:, 400:412] = False  # a dry gap of .6 mm
    assert iou(prepare(page(broken), (400.0, 400.0), "page").mask, broken) > 0.97
    small, large = stroke(5.0, 3.0, (400, 400)), stroke(16.0, 8.0, (400, 700))
    assert iou(prepare(page(small | large), (420.0, 400.0), "page").mask, small) > 0.95


def test_what_lies_outside_the_patch_is_not_seen_and_what_reaches_its_edge_is_cut() -> None:
    truth, neighbour = stroke(), stroke(20.0, 8.0, (400, 620))
    inside = prepare(page(truth | neighbour), None, "page", (0, 200, 800, 330))
    assert iou(inside.mask, truth) > 0.98
    assert not inside.cut
    assert prepare(page(truth), None, "page", (0, 0, 500, 800)).cut
    assert prepare(page(stroke(30.0, 8.0, (700, 400))), None, "page").cut


def test_rectify_puts_a_known_point_where_it_belongs() -> None:
    # An image of 10 px/mm with y downward and the paper's (0, 0) at pixel (50, 450).
    image_to_paper = np.array([[0.1, 0.0, -5.0], [0.0, -0.1, 45.0], [0.0, 0.0, 1.0]])
    image = np.full((500, 500), 255, np.uint8)
    cv2.circle(image, (150, 250), 10, 0, -1)  # paper (10, 20), radius 1 mm
    window = rectify(image, image_to_paper, (0.0, 10.0, 20.0, 20.0))
    assert window.shape == (400, 400)
    ys, xs = np.nonzero(window < 128)
    assert (xs.mean() + 0.5) / PX_PER_MM == pytest.approx(10.0, abs=0.03)
    assert (ys.mean() + 0.5) / PX_PER_MM == pytest.approx(10.0, abs=0.03)  # 10 mm below the window's far edge


def test_a_photograph_of_known_scale_keeps_its_millimetres() -> None:
    image = np.full((350, 480), 255, np.uint8)
    image[100:150, 200:300] = 30  # 100 x 50 px at 5 x 10 px/mm: 20 x 5 mm
    raster = rescale(image, (5.0, 10.0), "photo")
    measured = measure(prepare(raster, None, "photo").mask)
    assert measured.length_mm == pytest.approx(20.0, abs=0.2)
    assert measured.width_mm == pytest.approx(5.0, abs=0.15)
    assert measured.area_mm2 == pytest.approx(100.0, rel=0.03)
    with pytest.raises(CaptureRefused, match="allowed 8 to 8192"):
        rescale(np.full((400, 4000), 255, np.uint8), (1.0, 1.0), "photo")


def test_holes_of_glare_do_not_narrow_a_stroke_but_are_no_ink() -> None:
    whole, holed = stroke(20.0, 10.0), stroke(20.0, 10.0)
    holed[385:415, 300:500] = False  # a stripe of glare along the stroke, 1.5 mm
    assert measure(holed).width_mm == pytest.approx(measure(whole).width_mm, abs=0.2)
    assert measure(holed).area_mm2 < measure(whole).area_mm2 - 10.0


# The stroke that came between two photographs of one page

DATA = Path(__file__).parents[3] / "shared" / "data" / "frida_page_sequence"
WORST_START_MM = 10.0
PAGE_PX_PER_MM = 2.7474


def photographed(
    *strokes: tuple[int, int, int, int], light: float = 1.0, shift: tuple[float, float] = (0, 0)
) -> np.ndarray:
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
    found = new_stroke(photographed(*OLD), photographed(*OLD, NEW, light=light, shift=shift), 4.0, "page")
    assert iou(found.mask, truth > 0) > 0.995
    assert not any(flag.startswith(("crosses", "cut")) for flag in found.flags)
    said_px = [float(flag.split()[4]) for flag in found.flags if flag.startswith("moved: the page lay")]
    moved_px = math.hypot(*shift)
    assert said_px == ([pytest.approx(moved_px, abs=0.2)] if moved_px > 1.0 else [])


def test_what_lies_on_older_ink_is_said_to_be_hidden() -> None:
    found = new_stroke(photographed(*OLD), photographed(*OLD, (180, 110, 90, 16)), 4.0, "page")
    assert any(flag.startswith("crosses") for flag in found.flags)


def test_a_page_on_which_nothing_came_is_refused() -> None:
    with pytest.raises(CaptureRefused, match="no new stroke"):
        new_stroke(photographed(*OLD), photographed(*OLD, light=0.95), 4.0, "page")
    with pytest.raises(CaptureRefused, match="is 300 x 200 px"):
        new_stroke(photographed(), photographed()[:200, :300], 4.0, "page")


@pytest.mark.soak  # half a minute
@pytest.mark.skipif(not DATA.is_dir(), reason="the real page sequence is not here")
def test_on_a_real_page_every_stroke_is_found_and_starts_are_nearer_than_in_a_plain_difference() -> None:
    """Starts are compared once an affine map took the commanded page to the photographed one: the page was not
    calibrated. The plain difference takes another stroke for the new one three times; these three are left out."""
    rows = rows_of(DATA / "strokes.csv")
    assert len(rows) == 40
    commanded, ours, plain = (np.zeros((40, 2)) for _ in range(3))
    for k, row in enumerate(rows):
        before, after = (cv2.imread(str(DATA / row[name]), 0) for name in ("before", "after"))
        commanded[k] = float(row["start_x_px"]), float(row["start_y_px"])
        found = new_stroke(before, after, PAGE_PX_PER_MM, row["after"], near_px=tuple(commanded[k]))
        ours[k] = found.start_px(PAGE_PX_PER_MM)
        assert np.hypot(*(ours[k] - commanded[k])) < WORST_START_MM * PAGE_PX_PER_MM, row["after"]
        _, labels, stats, _ = cv2.connectedComponentsWithStats((cv2.subtract(before, after) > 40).astype(np.uint8))
        ys, xs = np.nonzero(labels == 1 + np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        plain[k] = xs.min(), ys[xs < xs.min() + 3].mean()
    same = np.hypot(*(plain - commanded).T) < 20.0 * PAGE_PX_PER_MM
    assert np.count_nonzero(same) == 37

    def scatter_mm(starts: np.ndarray) -> np.ndarray:
        to_page = np.column_stack([np.ones(37), commanded[same]])
        map_px, *_ = np.linalg.lstsq(to_page, starts[same], rcond=None)
        return (starts[same] - to_page @ map_px).std(axis=0) / PAGE_PX_PER_MM

    x, y = scatter_mm(ours) / scatter_mm(plain)
    assert x < 0.8
    assert y < 0.95
