"""The benchmarks run, report the agreed fields, and refuse unknown names."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from bench import raster
from bench.harness import Result, interleave
from model.ccdbsm import Brush, ccdbsm

ROOT = Path(__file__).resolve().parent.parent


def test_raster_reports_the_agreed_fields() -> None:
    result = raster.run(n=1, seed=3)
    fields = json.loads(result.to_json())
    assert list(fields) == ["name", "value", "unit", "peer", "ratio", "n", "seed"]
    assert (result.name, result.unit, result.n, result.seed) == ("raster", "images/s", 1, 3)
    assert result.value > 0
    assert result.ratio > 0


def test_the_peer_draws_the_same_mark_a_little_too_large() -> None:
    mark = ccdbsm(Brush(), 15.0, 5.0)
    image = raster.fill(raster.outlines(mark)[0])
    painted_mm2 = image.sum() / 255 * 0.2**2
    assert 1.0 < painted_mm2 / mark.area_mm2.item() < 1.03


def test_contestants_take_turns_after_one_warm_up_each() -> None:
    calls: list[str] = []
    interleave(lambda: calls.append("ours"), lambda: calls.append("peer"), 2)
    assert calls == ["ours", "peer"] * 3
    with pytest.raises(ValueError, match="n = 0"):
        interleave(list, list, 0)


def test_the_line_for_people_says_what_the_ratio_means() -> None:
    line = Result(name="x", value=1234.5, unit="images/s", peer="p", ratio=2.0, n=5, seed=0).to_line()
    assert line == "x: 1,234 images/s, 2.00 x p (above 1 is better; n = 5, seed = 0)"


def test_unknown_name_is_one_line_and_exit_code_2() -> None:
    command = [sys.executable, "-m", "bench", "rasta"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "unknown bench 'rasta'; known: raster, startup\n"
