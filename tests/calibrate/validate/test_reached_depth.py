"""The depth that the arm reached stands beside the commanded one, and a report names the largest difference."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path

import pytest

import brushloop
from brushloop.calibrate.validate.findings import trust
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Stroke


@pytest.mark.parametrize(("off_mm", "said"), [(0.2, True), (0.05, False)])
def test_commanded_and_reached_depth_stand_side_by_side(
    session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, off_mm: float, said: bool
) -> None:
    records = Recording.stroke_records

    def reached(recording: Recording) -> Iterator[Stroke]:
        for number, stroke in enumerate(records(recording)):
            assert stroke.depth_mm is not None
            depth = None if number == 0 else stroke.depth_mm - (off_mm if number == 3 else 0.01)
            yield stroke.model_copy(update={"reached_mm": depth})

    monkeypatch.setattr(Recording, "stroke_records", reached)
    output = brushloop.validate(session, models=("ccd-bsm",), held_out=False, out=tmp_path / "validation")
    with (tmp_path / "validation" / "scores.csv").open(encoding="utf-8") as file:
        rows = {row["stroke_id"]: row for row in csv.DictReader(file)}
    names = [stroke.stroke_id for stroke in records(Recording(session))]
    assert rows[names[0]]["reached_mm"] == ""
    fourth = rows[names[3]]
    assert float(fourth["depth_mm"]) - float(fourth["reached_mm"]) == pytest.approx(off_mm)
    assert output.report is not None
    told = [point.text for point in trust(output.report) if names[3] in point.text and "reached" in point.text]
    assert bool(told) == said
