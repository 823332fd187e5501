"""The benchmarks run, report the agreed fields, and refuse unknown names."""

import datetime as dt
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import bench.__main__
from bench import overhead, raster, table, whole
from bench.harness import BenchError, Result, interleave, percentile, results_of
from bench.peak import measure
from bench.processes import started
from brushloop.model.brush import Brush
from brushloop.model.ccdbsm import ccdbsm
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent


def test_raster_reports_the_agreed_fields() -> None:
    result = next(one for one in results_of(raster.run(n=1, seed=3)) if one.name == "raster-press")
    fields = json.loads(result.to_json())
    assert list(fields) == ["name", "value", "unit", "peer", "ratio", "n", "seed", "conditions", "quickest", "median"]
    assert (result.name, result.unit, result.n, result.seed) == ("raster-press", "images/s", 1, 3)
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


def test_peak_memory_is_of_the_command_alone() -> None:
    ballast = b"x" * 300_000_000  # what a process that is forked from here would be charged with
    small = measure(sys.executable, "-I", "-S", "-c", "pass")
    large = measure(sys.executable, "-I", "-S", "-c", "b'x' * 80_000_000")
    assert len(ballast) == 300_000_000
    assert small.peak_mb < 40
    assert 80 < large.peak_mb < 120
    with pytest.raises(BenchError, match="ended with 3: no such thing"):
        measure(sys.executable, "-S", "-c", "import sys; sys.stderr.write('no such thing'); sys.exit(3)")


def test_the_line_for_people_says_what_the_ratio_means() -> None:
    line = Result(name="x", value=1234.5, unit="images/s", peer="p", ratio=2.0, n=5, seed=0).to_line()
    assert line == "x: 1,234 images/s, 2.00 x p (above 1 is better; n = 5, seed = 0)"


def test_people_read_shared_conditions_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    results = [
        Result(name, 1.0, "ms", "p", 1.0, 1, 0, conditions) for name, conditions in (("a", "x"), ("b", "x"), ("c", "y"))
    ]
    monkeypatch.setattr(bench.__main__, "benches", lambda: {"three": lambda n=None: results})
    assert bench.__main__.main(["three"]) == 0
    assert [line[:3] for line in capsys.readouterr().out.splitlines()] == ["# x", "a: ", "b: ", "# y", "c: "]


def test_one_bench_may_return_several_results_a_line_each(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = (Result(name, 1.0, "ms", "p", 1.0, 1, 0) for name in ("one", "two"))
    assert list(results_of(one)) == [one]
    monkeypatch.setattr(bench.__main__, "benches", lambda: {"both": lambda n=None: [one, two]})
    assert bench.__main__.main(["both", "--json"]) == 0
    assert [json.loads(line)["name"] for line in capsys.readouterr().out.splitlines()] == ["one", "two"]


@pytest.mark.parametrize(("percent", "value"), [(50, 2.0), (75, 3.0), (99, 4.0), (100, 4.0), (0, 1.0)])
def test_a_percentile_is_one_of_the_values(percent: float, value: float) -> None:
    assert percentile([3.0, 1.0, 4.0, 2.0], percent) == value


def test_a_helper_process_that_ends_early_is_an_error_of_the_bench() -> None:
    with pytest.raises(BenchError, match="ended with 1"), started("bench.overhead", "nonsense"):
        pass


def test_every_bench_belongs_to_one_run() -> None:
    assert sorted([*whole.SPEED, *whole.ACCURACY]) == sorted(bench.__main__.benches())
    assert sum(whole.SPEED.values()) <= 15 * 60


def test_a_bench_that_fails_or_hangs_costs_its_own_figures_only(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[str] = []

    def run(command: list[str], *, timeout: float, **_options: object) -> subprocess.CompletedProcess[str]:
        ran.append(command[3])
        if command[3] == "b":
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, 1 if command[3] == "c" else 0)

    monkeypatch.setattr(whole.subprocess, "run", run)
    said: list[str] = []
    assert whole.run_all({"a": 60, "b": 30, "c": 10, "d": 100}, ["--table"], said.append) == ["b", "c"]
    assert ran == ["a", "b", "c", "d"]
    assert said[:2] == [
        "[1 of 4] a: about 60 s (30 % of all), about 3 min left",
        "[2 of 4] b: about 30 s (15 % of all), about 2 min left",
    ]
    assert "b: not measured: it was ended after 360 s" in said
    assert "c: not measured: it ended with 1" in said


def test_a_number_of_rounds_goes_with_one_bench(capsys: pytest.CaptureFixture[str]) -> None:
    assert bench.__main__.main(["-n", "3"]) == 2
    assert capsys.readouterr().err == "-n: goes with a NAME\n"


def test_unknown_name_is_one_line_and_exit_code_2() -> None:
    command = [sys.executable, "-m", "bench", "rasta"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == f"unknown bench 'rasta'; known: {', '.join(bench.__main__.benches())}\n"


def test_a_part_that_took_no_time_is_not_published_as_a_negative_one() -> None:
    """The dwell of a press lies within the wait for a steady arm: nothing is left of the rest to take it from."""
    spans = {"dip": [(0.0, 1.0)], "capture": [(9.0, 10.0)], "motion": [(0.0, 9.0)], "merge": [(10.0, 10.5)]}
    watch = overhead.Watch()
    watch.spans.update(spans | {"encode the still": [(9.0, 10.0)]})
    found = {one.name: one for one in overhead._results(watch, 1, 0)}
    assert "overhead: the rest" not in found
    assert all(one.value >= 0.0 and one.ratio < 1e5 for one in found.values())
    assert found["overhead: software"].value == pytest.approx(100.0 * 1.5 / 9.0)
