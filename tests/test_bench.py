"""The benchmarks run, report the agreed fields, and refuse unknown names."""

import datetime as dt
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import bench.__main__
from bench import raster, table, whole
from bench.harness import Result, interleave, results_of
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent


def test_raster_reports_the_agreed_fields() -> None:
    result = next(one for one in results_of(raster.run(n=1, seed=3)) if one.name == "raster-press")
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
    assert turns.ratios(2.0) == {"quickest": 2 * 5.5 / 1.5, "median": 2 * 32.5 / 10.5}


def test_the_table_keeps_rows_that_were_not_measured_and_names_missed_goals(tmp_path: Path) -> None:
    path = tmp_path / "bench.md"
    fast = Result("raster-press", 5e5, "images/s", "cv2", 41.0, 60, 0, quickest=41.0, median=39.5)
    table.renew([fast, Result("startup", 0.2, "s", "import typer", 0.9, 10, 3)], path)
    table.renew([replace(fast, ratio=12.0)], path)
    rows = [line for line in path.read_text().splitlines() if line.startswith("| `")]
    assert [table.name_of(line) for line in rows] == ["raster-press", "startup"]
    assert "**Goals that are missed:** `raster-press`." in path.read_text()
    assert all(line.endswith(f"| {dt.date.today()} |") for line in rows)
    assert "| `raster-press` | 500,000 images/s | 12.00 | 41.00, 39.50 | cv2 | 40, **missed** | 60 | 0 |" in rows[0]
    assert "| 0.90 |  | import typer |  | 10 | 3 | Python" in rows[1]


def test_a_figure_beside_its_goal_asks_for_a_ratio(tmp_path: Path) -> None:
    peers = {"overhead: software": "the goal (2 %)", "validate-memory": "1.05 times", "validate.dask": "x"}
    path = tmp_path / "bench.md"
    table.renew([Result(name, 3.0, "", peer, 0.95, 4, 0) for name, peer in peers.items()], path)
    goals = [line.split(" | ")[5] for line in path.read_text().splitlines() if line.startswith("| `")]
    assert goals == ["1, **missed**", "1, **missed**", ""]


def test_every_bench_belongs_to_one_run() -> None:
    assert sorted([*whole.SPEED, *whole.ACCURACY]) == sorted(bench.__main__.benches())
    assert sum(whole.SPEED.values()) <= 15 * 60


def test_unknown_name_is_one_line_and_exit_code_2() -> None:
    command = [sys.executable, "-m", "bench", "rasta"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"unknown bench 'rasta'; known: {', '.join(bench.__main__.benches())}\n"
