"""`bench written` without its rig: sheets are put in as they are asked for, and rows become results."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from bench import written
from bench.harness import BenchError
from brushloop.calibrate.writing.scores import REFERENCE
from tests.calibrate.records import table_of


class Rig:
    """Counts the sheets that are put in."""

    def __init__(self) -> None:
        self.sheets = 0

    def ask(self) -> str:
        self.sheets += 1
        return "fresh"


def answering(monkeypatch: pytest.MonkeyPatch, *ends: tuple[int, str]) -> list[list[str]]:
    """Commands end so, one after the other; returns what was run."""
    ran: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        code, said = ends[min(len(ran), len(ends) - 1)]
        ran.append(command)
        return subprocess.CompletedProcess(command, code, "", said)

    monkeypatch.setattr(written.subprocess, "run", run)
    return ran


def test_a_fresh_sheet_is_put_in_wherever_one_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    rig: Any = Rig()
    ran = answering(monkeypatch, (4, "repeat it with --sheet 2"), (2, "a new sheet: --sheet\n1"), (0, ""))
    written._to_its_end(["write"], rig)
    assert rig.sheets == 2
    assert [words[3:] for words in ran] == [["write"], ["write", "--sheet", "2"], ["write", "--sheet", "1"]]


def test_whatever_else_is_wrong_ends_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    rig: Any = Rig()
    answering(monkeypatch, (2, "brushloop: the lens is covered"))
    with pytest.raises(BenchError, match="ended with 2: brushloop: the lens is covered"):
        written._to_its_end(["write"], rig)
    answering(monkeypatch, (4, "--sheet 3"))
    with pytest.raises(BenchError, match="has asked for 40 sheets"):
        written._to_its_end(["write"], rig)


def test_the_peer_is_the_unlearned_round() -> None:
    after = table_of("字")
    worse = [row.model_copy(update={"csim": tuple(value - 15.0 for value in row.csim)}) for row in after]
    result = written._result("paper", "字", REFERENCE, [worse, after], after, [85.5, 84.5], seed=1)
    assert result.value == pytest.approx(85.0)
    assert result.ratio == pytest.approx(30.0 / 15.0)
    assert result.n == 2
    assert result.conditions.startswith("loopback rig, brush paper, 字, 2 writings; rounds 70.0 85.0;")
    assert "first writing 85.5, last 84.5" in result.conditions
    assert "the paper's robot writing: 93.6 and 74.6" in result.conditions
    with pytest.raises(BenchError, match="has no row “captured, reference” of 永"):
        written._result("paper", "永", REFERENCE, [worse], after, [85.0], seed=1)


def test_single_writings_are_read_in_the_order_of_writing(tmp_path: Path) -> None:
    head = "character,stroke_id,pair,alignment,tone,polarity,csim,ssim,source\n"
    rows = [
        f'字,字-r{k:02d},"{REFERENCE}",mm,binary,{key},0.9{k},0.8,loopback rig'
        for k in (1, 2)
        for key in ("ink = 1", "paper = 1")
    ]
    (tmp_path / "written.csv").write_text(head + "\n".join(rows), encoding="utf-8")
    assert written.csim_of_writings(tmp_path / "written.csv") == {"字": [pytest.approx(91.0), pytest.approx(92.0)]}


@pytest.mark.parametrize("n", [0, 7])
def test_there_are_six_brushes(n: int) -> None:
    with pytest.raises(ValueError, match="1 to 6 brushes"):
        written.run(n=n)
