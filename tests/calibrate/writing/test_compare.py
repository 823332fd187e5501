"""Written characters against simulation and reference: all of a cell's ink, both polarities, Table 3 as data."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from brushloop.calibrate.compare import Alignment, Polarity, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.writing import Figure, Plan, PlannedBy, as_points, load_plan
from brushloop.calibrate.writing.compare import (
    ANOTHER,
    HEADLINE,
    KEYS,
    PLANNED,
    REFERENCE,
    SIMULATED,
    Character,
    WritingComparison,
    aligned,
    as_ink,
    compare_ink,
    read_written,
)
from tests.calibrate.records import written_record


def cross(dx: int = 0, width: int = 8) -> np.ndarray:
    """(128, 128) ink: two bars, moved to the right."""
    image = np.zeros((128, 128), np.float32)
    image[60 : 60 + width, 30 + dx : 100 + dx] = 1.0
    image[30:100, 62 + dx : 62 + dx + width] = 1.0
    return image


def test_size_normalised_forgives_place_and_size_and_mm_does_not() -> None:
    small = cv2.resize(cross(), (64, 64), interpolation=cv2.INTER_AREA)
    moved = np.zeros((128, 128), np.float32)
    moved[5:69, 50:114] = small
    for tone in Tone:
        near = compare_ink(as_ink(cross()), as_ink(moved), (Alignment.SIZE_NORMALISED, tone, Polarity.INK))
        far = compare_ink(as_ink(cross()), as_ink(moved), (Alignment.MM, tone, Polarity.INK))
        assert near[0] > 0.93
        assert far[0] < 0.5
    whole = aligned(cross(), Alignment.SIZE_NORMALISED) > 0.5
    assert np.ptp(np.flatnonzero(whole.any(axis=1))) + 1 == pytest.approx(100, abs=2)


def character(writings: int = 3) -> Character:
    captured = {f"x-r{k + 1:02d}": as_ink(cross(k)) for k in range(writings)}
    figure = Figure(name="x", source="font of the test", wanted=cross(), simulated=cross(width=10))
    return Character(figure, captured)


def test_table_3_has_a_row_for_each_comparison_and_survives_the_disk(tmp_path: Path) -> None:
    rows = WritingComparison(None, None, [character()]).table_3
    assert len(rows) == len(KEYS) * 4
    strict = {row.pair: row for row in rows if (row.alignment, row.tone, row.polarity) == HEADLINE}
    assert [strict[pair].csim.n for pair in (SIMULATED, REFERENCE, PLANNED, ANOTHER)] == [3, 3, 1, 3]
    csim = strict[REFERENCE].csim
    assert csim.max == pytest.approx(100.0)
    assert csim.max > csim.avg > csim.min
    assert strict[REFERENCE].reference == "font of the test"
    # The middle one is nearest to the two others, and a writing alone has no other.
    assert character().scores[ANOTHER, HEADLINE][:, 0].argmax() == 1
    assert ANOTHER not in {row.pair for row in WritingComparison(None, None, [character(1)]).table_3}

    path = tmp_path / "written.json"
    path.write_text(written_record(table_3=rows).to_json())
    assert read_written(tmp_path).table_3 == rows
    path.write_text(path.read_text().replace("loopback rig", "real capture"))
    with pytest.raises(CalibrationError, match=r"written\.json: was edited"):
        read_written(path)
    path.write_text("{}")
    with pytest.raises(CalibrationError, match="not a report with a digest: write it with `brushloop write compare`"):
        read_written(path)


def test_a_plan_keeps_its_images_and_its_points(tmp_path: Path) -> None:
    strokes = [np.array([[1.0, 2.0, 3.0, 4.0, -0.0001], [5.5, 6.25, 7.125, 8.0, 9.0]])]
    figure = Figure(name="x", source="font", commanded=as_points(strokes), wanted=cross(), simulated=cross(width=10))
    plan = Plan(model="CCD-BSM", planned_by=PlannedBy(), cell_mm=60.0, software="test", figures=(figure,))
    text = plan.model_dump_json()
    (tmp_path / "plan.json").write_text(text)
    loaded = load_plan(tmp_path)
    assert loaded.model_dump_json() == text
    np.testing.assert_array_equal(loaded.figures[0].wanted, cross())
    # What the protocol holds has three decimals.
    assert loaded.figures[0].commanded == (((1, 2, 3, 4, 0), (5.5, 6.25, 7.125, 8, 9)),)
    picture = json.loads(text)["figures"][0]["wanted"]
    for old, new, words in ((picture, "AAAA", "figures.0.wanted: .*not a picture"), ("60.0", "NaN", "cell_mm")):
        (tmp_path / "plan.json").write_text(text.replace(old, new))
        with pytest.raises(CalibrationError, match=rf"plan\.json: {words}"):
            load_plan(tmp_path)
