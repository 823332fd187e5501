"""Cells that a spreadsheet would run are written as text, numbers stay numbers, and names come back as they were."""

import csv
import io

import pytest

from brushloop.sessions.disk import as_cell, as_text, csv_text, number
from brushloop.sessions.export import export
from brushloop.sessions.imports import ImportOptions
from brushloop.sessions.recording import Recording

FORMULAS = ['=cmd|"/c calc"!A1', "+1+2", "-1+2", "@SUM(A1)", "\tx", "\r=1", "'=1", "''=1", "＝1"]


@pytest.mark.parametrize("text", FORMULAS)
def test_a_formula_is_written_as_text_and_read_as_it_was(text):
    cell, other = next(csv.reader(io.StringIO(csv_text([text, "plain"], [], "\r\n"), newline="")))
    assert cell == f"'{text}"
    assert (as_text(cell), other) == (text, "plain")


@pytest.mark.parametrize("value", [-1.5, 3, None, "-0.5", "+1e3", "", "H13-a05", "it's", "'quoted'", "字"])
def test_numbers_stay_numbers_and_other_text_stays_itself(value):
    assert as_cell(value) == value


def test_names_go_out_and_in_again_by_our_own_importer(make, tmp_path, photos, run):
    names = ["=1+1", "@home", "-2-3", "-5", "'=x", "a"]
    rows = [{"file": f"{k}.png", "name": str(as_cell(name)), "px_per_mm": "5"} for k, name in enumerate(names)]
    make.photographs(photos, *rows)
    recorded = run(ImportOptions())
    assert [stroke.stroke_id for stroke in Recording(recorded).stroke_records()] == names

    export(recorded, tmp_path / "exported", "png")
    with (tmp_path / "exported" / "strokes.csv").open(newline="", encoding="utf-8") as file:
        cells = [row["stroke_id"] for row in csv.DictReader(file)]
    assert cells == ["'=1+1", "'@home", "'-2-3", "-5", "''=x", "a"]
    assert [as_text(cell) for cell in cells] == names


@pytest.mark.parametrize(("text", "value"), [("10", 10.0), (" -.5 ", -0.5), ("+1.e3", 1000.0), ("2.5E-1", 0.25)])
def test_a_number_is_read_as_it_is_written(text: str, value: float) -> None:
    assert number(text) == value


@pytest.mark.parametrize("text", ["1_0", "1e1_0", "nan", "-inf", "1e999", "", "0x10", "1,5", "1 0", "１０"])
def test_what_nobody_writes_as_a_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not a finite number"):
        number(text)
