"""The brush of a twin, the search for it on shallow presses, and `brushloop twin` with its file and its processes."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.calibrate.artefact import FittedValue
from brushloop.calibrate.compare import Alignment, Tone, field_grid
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.stats import CEILING, Summary
from brushloop.collect.rig.config import QualityConfig
from brushloop.drivers.loopback import RigRefused
from brushloop.drivers.sim.brush.brush import Brush
from brushloop.drivers.sim.brush.brush_file import LIKE_TABLE_2, CameraNoise, SoundHead, load_brush
from brushloop.drivers.sim.brush.misfit import MODES, Misfit
from brushloop.drivers.sim.brush.spec import ALLOWED, BrushSpec
from brushloop.model.presses import Grid, Presses
from brushloop.twin.brush import HERE, SHAPE, SPREAD, Constant, Vector, draw, with_values
from brushloop.twin.run import (
    LEAST_MISPLACED_MM,
    MECHANICS,
    PARTS,
    Twin,
    TwinStopped,
    fit_twin,
    fitted_value,
    noise_of,
    sound_head,
    twin_toml,
    workers,
)
from brushloop.twin.search import Target, fit_spread, of_parts, off, search, start
from tests.command import refused, said
from tests.photographed import imported_presses
from tests.waiting import wait_until

GRID = Grid(np.arange(-20.0, 6.0, 0.4), np.arange(8.0, -8.0, -0.4))
CONDITIONS = ((3.0, 0.0), (4.0, 5.0))
BASE = BrushSpec(seed=0)
ONE_THREAD = ThreadPoolExecutor(1)
"""Draws presses in this process: processes of their own take seconds to start."""


@given(st.sampled_from([*SHAPE, *SPREAD]), st.floats(-8.0, 8.0))
def test_a_value_is_one_that_the_brush_allows_and_lies_where_it_says(one: Constant, scales: float) -> None:
    low, high = ALLOWED[one.name]
    value = one.value(scales)
    assert low <= value <= high
    assert one.value(0.0) == getattr(BrushSpec(), one.name)
    if low < value < high:
        assert one.scales(value) == pytest.approx(scales, abs=1e-6)


def middle_mm(ink: np.ndarray) -> tuple[float, float]:
    x, y = (ink.sum(axis=0) * GRID.x_mm).sum(), (ink.sum(axis=1) * GRID.y_mm).sum()
    return float(x / ink.sum()), float(y / ink.sum())


def test_a_mark_has_the_area_and_the_place_of_the_press_that_it_stands_for() -> None:
    ink, moved, deeper = (
        draw(BrushSpec(), place, [(4.0, 5.0)], GRID)[0, 0] for place in (HERE, (0.0, 1.0, 2.0), (0.5, 0.0, 0.0))
    )
    brush = Brush(BrushSpec())
    mark = brush.print_descent(brush.descents([4.0], 5.0)[4.0], ink_load=1.0, press_seed=0, px_per_mm=5.0)
    inked = mark.density > 0.3
    assert ink.sum() * GRID.px_mm**2 == pytest.approx(inked.sum() / 25.0, rel=0.01)
    rows, columns = np.nonzero(inked)
    x, y = (columns + 0.5 - mark.origin_px[0]) / 5.0, (mark.origin_px[1] - rows - 0.5) / 5.0
    assert middle_mm(ink) == pytest.approx((x.mean(), y.mean()), abs=0.03)
    assert np.subtract(middle_mm(moved), middle_mm(ink)) == pytest.approx((1.0, 2.0), abs=0.03)
    assert deeper.sum() > ink.sum()


def test_the_quality_limits_hold_for_other_presses_of_the_brush() -> None:
    grid, conditions = field_grid(), [(11.0, 0.0), (20.0, 10.0)]
    brush = Brush(load_brush(Path(LIKE_TABLE_2)).brush)
    head = sound_head(brush.spec, conditions, grid)
    assert head is not None
    for depth_mm, tilt_deg in conditions:
        mark = brush.press(depth_mm, tilt_deg, ink_load=1.0, press_seed=7)
        columns = np.flatnonzero((mark.density > 0.5).any(axis=0))
        begins_mm = (columns[-1] + 1 - mark.origin_px[0]) / mark.px_per_mm
        assert abs(begins_mm - head.head_mm) < head.misplaced_mm - 0.5
    default = sound_head(BrushSpec(), conditions, grid)
    assert default is not None
    assert default.misplaced_mm == LEAST_MISPLACED_MM == QualityConfig().misplaced_mm
    assert default.head_mm == pytest.approx(QualityConfig().head_mm, abs=0.3)
    assert sound_head(BrushSpec(), conditions[:1], replace(grid, y_mm=grid.y_mm + 50.0)) is None


def test_a_search_comes_nearer_to_a_brush_that_gives_ink_from_higher_over_the_paper(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("brushloop.twin.search.STEPS", 2)
    ink = draw(replace(BASE, film_mm=1.0), (0.0, 0.4, 0.0), CONDITIONS, GRID, repeats=2, first_seed=50)
    target = Target(BASE, CONDITIONS, GRID, ink.mean(axis=1))
    before = start()
    after = search(target, before, ONE_THREAD, 0.5)
    squares = [float((off(target, 0.5, one) ** 2).sum()) for one in (before, after)]
    assert squares[1] < 0.5 * squares[0]
    assert after[[one.name for one in SHAPE].index("film_mm")] > 0.15


def test_what_the_parts_disagree_on_is_not_determined() -> None:
    points = [np.array([1.0, 0.0]), np.array([1.0, 3.0]), np.array([1.0, -3.0])]
    assert of_parts(points) == pytest.approx([0.0, 2.0 / 3.0 * 18.0])
    assert of_parts(points[:1]) == 0.0
    errors = np.sqrt(of_parts(points))
    assert [fitted_value(SHAPE[k], 1.0, float(errors[k])).low is not None for k in (0, 1)] == [True, False]
    of_other_physics = fitted_value(SHAPE[0], 1.0, np.inf)
    assert (of_other_physics.value, of_other_physics.low) == (SHAPE[0].value(1.0), None)


@pytest.mark.parametrize(("name", "value", "least"), [("place_wander_mm", 0.4, 0.25), ("reach_wander_mm", 1.0, 0.2)])
def test_presses_that_differ_more_give_a_wider_spread_of_that_kind(name: str, value: float, least: float) -> None:
    captured = draw(replace(BrushSpec(), **{name: value}), HERE, CONDITIONS, GRID, repeats=6, first_seed=70)
    found = fit_spread(BrushSpec(), HERE, dict(zip(CONDITIONS, captured, strict=True)), GRID, ONE_THREAD)
    brush = with_values(BrushSpec(), SPREAD, found.point)
    assert least < getattr(brush, name) < 1.5 * value
    assert brush.strand_mm < 0.2
    assert found.twin_percent == pytest.approx(found.captured_percent, abs=6.0)  # small marks differ much


def test_the_shape_is_found_with_hairs_that_stray_as_those_of_the_captures(monkeypatch: pytest.MonkeyPatch) -> None:
    strays: list[tuple[float, float]] = []

    def counted(target: Target, found: Vector, _workers: Executor, blur_mm: float) -> Vector:
        strays.append((blur_mm, target.base.strand_mm))
        return found  # how a search finds its way is tested above

    for name, value in {"search.COARSE_MM": (1.0,), "run.FINE_MM": 0.5, "search.search": counted}.items():
        monkeypatch.setattr(f"brushloop.twin.{name}", value)
    condition = (3.0, 0.0)
    brush = replace(BrushSpec(), strand_mm=0.5)
    captured = draw(brush, HERE, [condition], GRID, repeats=4)[0]
    presses = Presses(brush.radius_mm, brush.length_mm, GRID, np.array([condition] * 4), captured)
    fit_twin(presses, ONE_THREAD)
    coarse, fine = strays
    assert coarse == (1.0, BrushSpec().strand_mm)
    assert fine[0] == 0.5
    assert fine[1] > BrushSpec().strand_mm


# `brushloop twin`, on an imported session of shallow presses, with a short search

PRESSED = [(height, tilt) for height in (3.0, 5.0) for tilt in (0.0, 5.0)]
HELD_OUT = Stat(
    model="twin", alignment=Alignment.MM, tone=Tone.BINARY, cell=None, csim=Summary(45, 95.1), ssim=Summary(45, 90.2)
)


class PowerCut(BaseException):
    pass


def test_a_session_gets_a_twin_and_a_run_that_was_broken_off_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = imported_presses(tmp_path, PRESSED, (200, 320), (250, 100))
    out, searched = tmp_path / "twin.toml", list[float]()

    def counted(_target: object, found: Vector, _workers: Executor, blur_mm: float) -> Vector:
        if len(searched) == 2 and not cut:
            cut.append(True)
            raise PowerCut
        searched.append(blur_mm)
        return found  # how a search finds its way is tested with it

    cut: list[bool] = []
    in_this_process = partial(nullcontext, ONE_THREAD)
    shorter = {"run.FINE_MM": 0.5, "run.VOTES": 1, "misfit.VOTES": 1, "search.COARSE_MM": (1.0,)}
    for name, value in {"run.workers": in_this_process, "search.search": counted, **shorter}.items():
        monkeypatch.setattr(f"brushloop.twin.{name}", value)
    command = "twin", session, "--out", out
    with pytest.raises(PowerCut):
        said(*command)
    assert not out.exists()
    assert searched == [1.0, 0.5]

    output = said(*command)
    assert searched == [1.0, 0.5] * (1 + PARTS)  # those of all conditions were not repeated
    unknown = "No condition has three captures", "The camera's noise was not measured"
    for words in ("friction", "a third of the conditions left out in turn", "next: brushloop sim --brush", *unknown):
        assert words in output
    assert load_brush(out).misfit is not None
    assert load_brush(out).name == "simulated bristle bundle (twin of presses, simulated)"
    assert "exists: give --out FILE or --replace" in refused(*command)


ALONG = ((0.2, *[0.0] * 5),) * MODES


def test_a_twin_is_read_back_and_what_is_not_determined_has_no_interval(tmp_path: Path) -> None:
    spec = BrushSpec(radius_mm=5.0, length_mm=42.0, friction=0.3, set_deg=9.0, seed=7)
    values = {
        one: FittedValue(value=getattr(spec, one.name), low=None if one.name == "set_deg" else 0.1, high=0.4)
        for one in SHAPE
    }
    polynomial = (0.5, *[-0.1] * 5)
    misfit = Misfit(
        depths_mm=(11.0, 20.0), tilts_deg=(0.0, 10.0), tip=polynomial, heel=polynomial, half=ALONG, middle=ALONG
    )
    rows = {CEILING: 98.0, "twin": 95.1, MECHANICS: 93.3}
    held_out = tuple(
        HELD_OUT.model_copy(update={"model": row, "csim": Summary(45, csim)}) for row, csim in rows.items()
    )
    fitted = Twin(spec, values, None, held_out, SoundHead(head_mm=2.2, misplaced_mm=4.0), misfit)
    path = tmp_path / "twin.toml"
    path.write_text("\n".join(twin_toml(fitted, 'session "1"\n', 1.234)))
    found = load_brush(path)
    assert (found.brush, found.camera, found.quality, found.misfit) == (
        spec,
        CameraNoise(noise=1.23),
        SoundHead(head_mm=2.2, misplaced_mm=4.0),
        misfit,
    )
    assert found.name == "simulated bristle bundle (twin of session ?1??, simulated)"
    lines = {line.split(" = ")[0]: line for line in path.read_text().splitlines()}
    assert lines["friction"].endswith("# 0.1 to 0.4; default 0.22")
    assert lines["set_deg"].endswith("# deg; not determined by these presses; default 8")
    assert any("lie 4.7 points of CSIM below the ceiling" in line for line in lines)
    path.write_text(path.read_text().replace("tip = [0.5", "tip = [500.0"))
    with pytest.raises(RigRefused, match=r"misfit\.tip\.0: .* less than or equal to 50"):
        load_brush(path)


def still(sd: float, seed: int) -> np.ndarray:
    """A page under uneven light with one more mark than the still before, as the simulated camera compresses it."""
    page = np.full((240, 320), 200.0) + np.linspace(0.0, 30.0, 320)
    page[20 : 60 + 10 * seed, 40 * seed : 40 * seed + 20] = 30.0
    noisy = np.clip(page + np.random.default_rng(seed).normal(0.0, sd, page.shape), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", noisy, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.uint8)


@pytest.mark.parametrize("sd", [1.0, 5.0])
def test_the_camera_s_noise_is_found_in_stills_of_one_view(sd: float) -> None:
    assert noise_of([still(sd, seed) for seed in range(4)]) == pytest.approx(sd, rel=0.15)
    assert noise_of([still(sd, 1), still(sd, 2)[:100]]) is None


PROGRAM = """
import os, time
from brushloop.twin.run import workers

if __name__ == "__main__":
    with workers(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        list(pool.map(time.sleep, [0.1] * 10_000))
"""


def test_a_command_that_is_killed_leaves_no_process_behind(tmp_path: Path) -> None:
    script = tmp_path / "drawing.py"
    script.write_text(PROGRAM)
    paths = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": paths}
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment) as command:
        assert command.stdout is not None
        worker = Path(f"/proc/{int(command.stdout.readline())}/status")
        command.kill()
    wait_until(lambda: not worker.exists() or "(zombie)" in worker.read_text(), "the worker's end")


def test_a_worker_that_ends_first_stops_the_command_in_one_line() -> None:
    with pytest.raises(TwinStopped, match="repeat the command to continue"), workers(1) as pool:
        pool.submit(os._exit, 1).result()
