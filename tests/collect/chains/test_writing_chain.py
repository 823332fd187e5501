"""The chain of `brushloop write`: practice comes before the plan, and learning ends when no character gains."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.calibrate.commands import (
    CompareWrittenRequest,
    FitFootprintRequest,
    LearnRequest,
    PlanRequest,
    PracticeRequest,
)
from brushloop.calibrate.files import Written
from brushloop.calibrate.writing import FILE as PLAN
from brushloop.calibrate.writing import PROTOCOL, Figure, Plan, PlannedBy
from brushloop.collect.chains import writing
from brushloop.collect.chains.writing import FOOTPRINT, Writing, WritingRequest
from brushloop.collect.errors import ConfigError
from brushloop.sessions.journal import JOURNAL_NAME

CELL = 'kind = "write"\ncell_mm = [48.0, 48.0]\nrepeats = {repeats}\n[[figures]]\nname = "子"\n[[figures.strokes]]\n'
POINTS = "points = [[10.0, 24.0, 3.0, 0.0, 0.0], [20.0, 24.0, 3.0, 0.0, 0.0]]\n"


def plan(settled: bool) -> Plan:
    figure = Figure(name="子", source="", settled=settled)
    return Plan(model="", planned_by=PlannedBy(), cell_mm=48.0, software="", figures=(figure,))


class Commands:
    """Stands in for brushloop's commands: writes what each would leave."""

    def __init__(self, settled_after: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ran: list[str] = []
        self._rounds, self._settled_after = 0, settled_after
        for name in ("plan.plan", "compare.compare", "learn.learn", "learn.practice", "learn.fit"):
            command = getattr(self, name.split(".")[1])
            monkeypatch.setattr(f"brushloop.calibrate.writing.{name}", command)

    def plan(self, request: PlanRequest, _: object) -> Written:
        return self._planned("plan", request.out, request.repeats)

    def practice(self, request: PracticeRequest, _: object) -> Written:
        return self._planned("practice", request.out, 1)

    def learn(self, request: LearnRequest, _: object) -> Written:
        self._rounds += 1
        settled = self._rounds >= self._settled_after
        return self._planned("learn", request.out, (request.settled_repeats if settled else None) or request.repeats)

    def fit(self, request: FitFootprintRequest, _: object) -> Written:
        self.ran.append("fit")
        return Written(request.session / FOOTPRINT / "0123456789abcdef.json", ())

    def compare(self, request: CompareWrittenRequest, _: object) -> Written:
        self.ran.append("compare")
        return Written(request.out / "written.html", ())

    def _planned(self, name: str, folder: Path, repeats: int) -> Written:
        self.ran.append(name)
        folder.mkdir(parents=True)
        (folder / PROTOCOL).write_text(CELL.format(repeats=repeats) + POINTS, encoding="utf-8")
        settled = self._rounds >= self._settled_after
        (folder / PLAN).write_text(plan(settled).model_dump_json(), encoding="utf-8")
        return Written(folder / PROTOCOL, ())


@pytest.mark.parametrize(("settled_after", "rounds"), [(1, 1), (9, 3)])
def test_practice_comes_first_and_learning_ends_when_all_is_settled(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    settled_after: int,
    rounds: int,
) -> None:
    class Rig:
        class brush:  # noqa: N801
            radius_mm, length_mm = 6.0, 48.0

    commands = Commands(settled_after, monkeypatch)
    monkeypatch.setattr(writing, "load_rig", lambda _: Rig)
    monkeypatch.setattr(writing, "collected_session", lambda *_: tmp_path / "session")
    request = WritingRequest("子", tmp_path / "rig.toml", tmp_path / "out", tmp_path, count=10, learn=3, practice=True)
    assert Writing(request).run() == tmp_path / "out" / "written.html"
    assert commands.ran == ["practice", "fit", "plan", *["compare", "learn"] * rounds, "compare"]
    assert ("No character gained" in capsys.readouterr().out) == (rounds < 3)


def test_a_fresh_sheet_is_asked_for_before_anything_is_planned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands = Commands(1, monkeypatch)
    (tmp_path / "2026-01-01-grid-01").mkdir()
    (tmp_path / "2026-01-01-grid-01" / JOURNAL_NAME).write_text("damaged\n", encoding="utf-8")
    request = WritingRequest("子", tmp_path / "rig.toml", tmp_path / "out", tmp_path, practice=True)
    with pytest.raises(ConfigError, match="Put a fresh sheet in"):
        Writing(request).run()
    assert commands.ran == []
