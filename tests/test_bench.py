"""Every bench is there, the page of results keeps what was not measured, and an unknown name is refused."""

import datetime as dt
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from bench import __main__ as front
from bench.harness import Result, at_most
from tests.waiting import PATIENCE_S


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


def test_every_bench_is_there_and_an_unknown_name_is_one_line() -> None:
    assert all(callable(front.bench_of(name)) for name in front.BENCHES)
    command = [sys.executable, "-m", "bench", "rasta"]
    ran = subprocess.run(
        command, cwd=Path(front.__file__).parents[1], capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr == f"unknown bench 'rasta'; known: {', '.join(front.BENCHES)}\n"
