"""The benchmarks run, report the agreed fields, keep their page, and refuse unknown names."""

import datetime as dt
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from bench import __main__ as front
from bench import images
from bench.harness import Result, at_most, interleave
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent


def test_raster_reports_the_agreed_fields() -> None:
    result = next(one for one in images.raster(n=1, seed=3) if one.name == "raster-press")
    fields = json.loads(result.to_json())
    assert list(fields) == ["name", "value", "unit", "peer", "ratio", "n", "seed", "conditions", "quickest", "median"]
    assert (result.name, result.unit, result.n, result.seed) == ("raster-press", "images/s", 1, 3)
    assert result.value > 0
    assert result.ratio > 0


def test_contestants_take_turns_after_one_warm_up_each() -> None:
    calls: list[str] = []
    interleave(lambda: calls.append("ours"), lambda: calls.append("peer"), 2)
    assert calls == ["ours", "peer"] * 3
    with pytest.raises(ValueError, match="n = 0"):
        interleave(list, list, 0)


def test_ratios_are_of_the_quickest_tenth_and_of_the_medians() -> None:
    ticks = iter([0.0, 0.0, *(t for k in range(1, 21) for t in (0.0, float(k), 0.0, 3.0 * k + 1.0))])
    turns = interleave(list, list, 20, clock=lambda: next(ticks))
    assert turns.quickest_s == (1.5, 5.5)
    assert turns.median_s == (10.5, 32.5)
    assert turns.ratios(2.0) == (2 * 5.5 / 1.5, 2 * 32.5 / 10.5)


def test_the_page_keeps_what_was_not_measured_and_names_missed_goals(tmp_path: Path) -> None:
    path = tmp_path / "results.md"
    fast = Result("raster-press", 5e5, "images/s", "cv2", 41.0, 60, 0, "quiet", quickest=41.0, median=39.5)
    front.renew("raster", [fast], path)
    front.renew("startup", [at_most("startup.collect", 0.02, "s", 0.06, 10, 3, "quiet")], path)
    front.renew("raster", [replace(fast, ratio=12.0)], path)
    text, today = path.read_text(), dt.date.today()
    assert [line for line in text.splitlines() if line.startswith("## ")] == ["## startup", "## raster"]
    assert "**Goals that are missed:** `raster-press`." in text
    raster = "12.00 (quickest tenth 41.00, median 39.50) | cv2 | 40, **missed** | 60 | 0"
    assert f"| `raster-press` | 500,000 images/s | {raster} | quiet | {today} |" in text
    assert f"| `startup.collect` | 0.02 s | 3.00 | goal 0.06 s at most | 1 | 10 | 3 | quiet | {today} |" in text


def test_every_bench_is_there() -> None:
    assert all(callable(front.bench_of(name)) for name in front.BENCHES)


def test_unknown_name_is_one_line_and_exit_code_2() -> None:
    command = [sys.executable, "-m", "bench", "rasta"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"unknown bench 'rasta'; known: {', '.join(front.BENCHES)}\n"
