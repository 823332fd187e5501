"""One command per table: loops and characters that lie beside are taken up, and what cannot be believed is refused."""

from __future__ import annotations

import csv
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.compare.paper import TABLE_1
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.loop.compare import LoopRecord
from brushloop.calibrate.validate import tables
from brushloop.calibrate.validate.models import KINDS_OF_PRESS, REPEATED
from brushloop.calibrate.validate.report import load_report
from brushloop.sessions.imports import ImportOptions, import_photographs
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Source
from tests.calibrate.records import loop_record, table_of, written_record

FAST = ("--model", "line", "--no-held-out", "--no-parquet")
HALF = '{"format": "brushloop-loop-2", "digest": "\\ud800"}'
"""Half a surrogate: JSON, but no text that a page could hold."""
PICTURE = cv2.imencode(".png", np.full((20, 40), 200, np.uint8))[1].tobytes()
MakeLoop = Callable[..., LoopRecord]


def invoke(*words: str | Path) -> str:
    ran = CliRunner().invoke(app, ["validate", *map(str, words), *FAST])
    assert ran.exit_code == 0, (ran.output, ran.exception)
    return " ".join(ran.output.split())


def refused(*words: str | Path) -> str:
    """What the front door would print, and end with exit code 2."""
    ran = CliRunner().invoke(app, ["validate", *map(str, words), *FAST])
    assert isinstance(ran.exception, CalibrationError), ran.output
    assert ran.exception.exit_code == 2
    return " ".join([str(ran.exception), *getattr(ran.exception, "__notes__", [])])


@pytest.fixture
def lab(session: Path, tmp_path: Path) -> Path:
    """A folder of sessions with one in it, of imported photographs."""
    shutil.copytree(session, tmp_path / "sessions" / session.name)
    return tmp_path


@pytest.fixture
def place(lab: Path, session: Path) -> Path:
    return lab / "sessions" / session.name


@pytest.fixture
def a_loop(place: Path) -> MakeLoop:
    """The loop of that session, with changes that are sealed in."""
    sha256 = Recording(place).sha256

    def make(**changes: Any) -> LoopRecord:
        fields: dict[str, Any] = {"original": place.name, "original_sha256": sha256, "source": Source.IMPORT}
        return loop_record(**(fields | changes))

    return make


def put(folder: Path, text: str, name: str = "loop.json") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def characters(folder: Path, **fields: Any) -> Path:
    """A `written` folder of imported photographs: only tests have such characters."""
    sealed = {"source": Source.IMPORT, "figure_13_sha256": hashlib.sha256(PICTURE).hexdigest()}
    record = written_record(**(sealed | fields))
    path = put(folder, record.to_json(), "written.json")
    (folder / "figure-13.png").write_bytes(PICTURE)
    return path


def test_a_loop_in_the_session_is_found_and_is_the_third_row_of_table_1(place: Path, a_loop: MakeLoop) -> None:
    loop = a_loop()
    put(place / "loop", loop.to_json())
    assert "6 strokes match their originals with a CSIM of 94.2 %, other presses of the same H and α 95.2 %" in invoke(
        place
    )
    folder = place / "validation"
    report = load_report(folder / "report.json")
    assert report.loops == (loop,)
    [row] = [row for row in tables.table_1(report) if row.label == "robot writing"]
    assert row.n == 6
    assert row.ours == pytest.approx((94.5, 94.0, 94.25, 84.5, 84.0, 84.25))
    assert row.paper == TABLE_1["robot writing"]
    with (folder / "summary.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["model"] == f"robot writing ({place.name}-replay)"]
    assert len(rows) == 2 * 2 * 2
    assert {r["source"] for r in rows} == {"imported photographs"}
    page = (folder / "report.html").read_text()
    for words in (f"{place.name} pressed again as {place.name}-replay", loop.digest, "at most 1 point less similar"):
        assert words in page

    assert "robot writing" not in invoke(place, "--no-beside")
    assert load_report(folder / "report.json").loops == ()


def test_several_loops_are_given_by_name_and_the_same_one_counts_once(
    place: Path, tmp_path: Path, a_loop: MakeLoop
) -> None:
    first = put(tmp_path / "a", a_loop().to_json())
    second = put(tmp_path / "b", a_loop(again="b").to_json())
    invoke(place, "--loop", first, "--loop", second.parent, "--loop", first.parent)
    report = load_report(place / "validation" / "report.json")
    assert [loop.again for loop in report.loops] == [f"{place.name}-replay", "b"]
    assert [row.n for row in tables.robot_writing(report)] == [6, 6]

    # Presses that this run scores itself are not listed twice.
    line = [stat.model_copy(update={"model": REPEATED}) for stat in report.stats if stat.model == "line"]
    here = report.sessions[0].model_copy(update={"recording_sha256": report.loops[0].again_sha256})
    both = {"stats": (*report.stats, *line), "models": (*report.models, *KINDS_OF_PRESS), "sessions": (here,)}
    assert [row.n for row in tables.robot_writing(report.model_copy(update=both))] == [10]


@pytest.mark.parametrize(
    ("changes", "edit", "words"),
    [
        ({}, ("imported photographs", "real capture"), "was edited: its digest does not match its contents"),
        ({}, ('"digest"', '"digested"'), "is not a report with a digest: write it with `brushloop loop compare`"),
        ({}, ("brushloop-loop-2", "brushloop-loop-9"), "format is 'brushloop-loop-9', expected 'brushloop-loop-2'"),
        ({"source": Source.LOOPBACK}, None, "is of loopback rig, presses.mcap of imported photographs"),
        ({"original": "other", "original_sha256": "3" * 64}, None, "repeats other, not presses"),
        ({"original_sha256": "3" * 64}, None, "is of another recording of presses: its SHA-256 differs"),
    ],
)
def test_a_loop_that_is_edited_or_of_something_else_is_refused_by_name(
    place: Path, a_loop: MakeLoop, changes: dict[str, Any], edit: tuple[str, str] | None, words: str
) -> None:
    text = a_loop(**changes).to_json()
    path = put(place / "loop", text if edit is None else text.replace(*edit))
    said = refused(place)
    assert said.startswith(f"{path}: {words}")
    assert said.endswith("(found beside the session; --no-beside ignores it)")
    assert not (place / "validation").exists()
    assert refused(place, "--loop", path) == said.partition(" (found")[0]


@pytest.mark.parametrize("text", ["", "[]", '"x"', "[" * 100_000, '{"format": 1, "digest": {}}', HALF])
def test_what_is_no_loop_at_all_is_refused(place: Path, text: str) -> None:
    path = put(place / "loop", text)
    assert refused(place).startswith(f"{path}: ")


def test_table_3_has_the_papers_rows_beside_and_figure_13(lab: Path, place: Path) -> None:
    characters(lab / "elsewhere")
    said = invoke(place, "--written", lab / "elsewhere")
    assert "Table 3: 字" in said
    assert "字, written 2 times by the arm, matches its reference (a font) with a CSIM of 85.0 %" in said
    folder = place / "validation"
    report = load_report(folder / "report.json")
    like, strict = tables.table_3(report)
    assert {row.label: None if row.paper is None else row.paper.csim[2] for row in like.rows} == {
        "simulated, ink = 1": 94.58,
        "robot writing, ink = 1": 93.59,
        "another writing, ink = 1": None,
        "the plan, ink = 1": None,
        "simulated, paper = 1": 94.58,
        "robot writing, paper = 1": 93.59,
    }
    assert "(beside the paper's CCD-BSMG)" in like.rows[0].basis
    assert all(row.paper is None for row in strict.rows)
    with (folder / "table3.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(report.written[0].table_3)
    assert float(rows[0]["csim_avg"]) == pytest.approx(85.0)
    assert {row["source"] for row in rows} == {"imported photographs"}
    assert (folder / "report.html").read_text().count("Figure 13") >= 2

    invoke(place)
    assert not (folder / "table3.csv").exists()


def test_characters_of_this_lab_are_found_and_others_are_left_out_with_the_reason(lab: Path, place: Path) -> None:
    for name in ("write-01", str(lab), "../sessions", ".", ""):
        characters(lab / "written", session=name)
        assert "is not beside it" in invoke(place)
    (lab / "sessions" / "write-01").mkdir()
    characters(lab / "written")
    assert "Table 3: 字" in invoke(place)
    characters(lab / "written", brush="goat hair")
    assert "it was written with another brush, goat hair" in invoke(place)
    assert "Table 3: 字" in invoke(place, "--written", lab / "written")

    characters(lab / "written", source=Source.LOOPBACK)
    assert "it is of loopback rig, not imported photographs" in invoke(place)
    assert "is of loopback rig, presses.mcap of imported photographs" in refused(place, "--written", lab / "written")
    # What lies in the session itself is meant for it.
    (lab / "written").rename(place / "written")
    assert "is of loopback rig" in refused(place)


def test_an_edited_table_3_or_another_picture_is_refused(lab: Path, place: Path) -> None:
    path = characters(lab / "w")
    text = path.read_text()
    path.write_text(text.replace('"字"', '"子"'))
    assert refused(place, "--written", path) == f"{path}: was edited: its digest does not match its contents"
    path.write_text(text)
    figure = lab / "w" / "figure-13.png"
    for data, words in (
        (PICTURE + b" ", "is not the picture of written.json beside it: its SHA-256 differs"),
        (PICTURE + bytes(17_000_000), "is larger than"),
    ):
        figure.write_bytes(data)
        assert refused(place, "--written", path).startswith(f"{figure}: {words}")
    figure.unlink()
    # A terminal breaks a long path anywhere.
    assert f"{figure} does not exist".replace(" ", "") in invoke(place, "--written", path).replace(" ", "")


def test_what_others_wrote_is_escaped(lab: Path, place: Path, a_loop: MakeLoop) -> None:
    bad = "<img src=x onerror=alert(1)>{{ 7 * 7 }}"
    named = dict.fromkeys(("model", "session", "brush", "command", "software"), bad)
    characters(lab / "w", table_3=table_of(bad, bad), **named)
    loop = put(lab / "l", a_loop(command=bad, software=bad, model=bad).to_json())
    assert "onerror=alert(1)>" in invoke(place, "--written", lab / "w", "--loop", loop)  # a terminal shows it as it is
    page = (place / "validation" / "report.html").read_text()
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;{{ 7 * 7 }}") > 8


def test_strokes_that_travel_have_no_such_tables(place: Path, tmp_path: Path, a_loop: MakeLoop) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "0.png").write_bytes(PICTURE)
    (photos / "strokes.csv").write_text("file,length_mm,depth_mm,px_per_mm\n0.png,2,1,8.0\n")
    drags = tmp_path / "drags"
    import_photographs(photos, photos / "strokes.csv", drags, ImportOptions(kind="drag"), "test", lambda: 1)
    loop = put(tmp_path / "l", a_loop().to_json())
    for option in ("--loop", "--written"):
        assert refused(drags, option, loop) == f"{option}: is for a report of presses; these are drags"
    assert not (drags / "validation").exists()
