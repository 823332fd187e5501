"""One command per table: loops and characters that lie beside are taken up, and what cannot be believed is refused."""

from __future__ import annotations

import hashlib
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from brushloop.calibrate.compare import NORMAL, STRICT, TABLE_1
from brushloop.calibrate.validate.tables import Report, table_1, table_3
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Source
from tests.calibrate.given import loop_record, rows_of, table_of, written_record
from tests.command import refused, said

FAST = ("--model", "line", "--no-held-out")
HALF = '{"format": "brushloop-loop-4", "digest": "\\ud800"}'
"""Half a surrogate: JSON, but no text that a page could hold."""
PICTURE = cv2.imencode(".png", np.full((20, 40), 200, np.uint8))[1].tobytes()


def report_of(place: Path) -> tuple[Report, str]:
    folder = place / "validation"
    return Report.read(folder), (folder / "report.html").read_text()


@pytest.fixture
def place(session: Path, tmp_path: Path) -> Path:
    """A session of imported photographs in a folder of sessions."""
    shutil.copytree(session, tmp_path / "sessions" / session.name)
    return tmp_path / "sessions" / session.name


def loop_text(place: Path, **changes: Any) -> str:
    """The loop of that session, with changes that are sealed in."""
    fields = {"original": place.name, "original_sha256": Recording(place).sha256, "source": Source.IMPORT}
    return loop_record(**(fields | changes)).to_json()


def put(folder: Path, text: str, name: str = "loop.json") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def characters(folder: Path, **fields: Any) -> Path:
    """A `written` folder of imported photographs: only tests have such characters."""
    sealed = {"source": Source.IMPORT, "figure_13_sha256": hashlib.sha256(PICTURE).hexdigest()}
    path = put(folder, written_record(**(sealed | fields)).to_json(), "written.json")
    (folder / "figure-13.png").write_bytes(PICTURE)
    return path


def test_a_loop_in_the_session_is_the_third_row_of_table_1(place: Path) -> None:
    put(place / "loop", loop_text(place))
    assert "than other presses of the same depth and tilt" in said("validate", place, *FAST, left_out=True)
    report, page = report_of(place)
    [row] = [row for row in table_1(report) if row.label == "robot writing"]
    assert row.scores is not None
    assert row.scores.csim.range_and_avg == pytest.approx((94.5, 94.0, 94.25))
    assert row.scores.ssim.range_and_avg == pytest.approx((84.5, 84.0, 84.25))
    assert row.paper == TABLE_1["robot writing"]
    summary = rows_of(place / "validation" / "summary.csv")
    rows = [row for row in summary if row["model"] == f"robot writing ({place.name}-replay)"]
    assert len(rows) == 2 * 2 * 2
    assert {(r["source"], r["below_ceiling"]) for r in rows} == {("imported photographs", "")}
    assert f"{place.name} pressed again as {place.name}-replay" in page
    assert report.loops[0].digest in page


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (("imported photographs", "real capture"), "was edited: its digest does not match its contents"),
        (('"digest"', '"digested"'), "is not a report with a digest: write it with `brushloop repress compare`"),
        (("brushloop-loop-4", "brushloop-loop-9"), "format is 'brushloop-loop-9', not 'brushloop-loop-4'"),
    ],
)
def test_an_edited_loop_is_refused_by_name(place: Path, edit: tuple[str, str], words: str) -> None:
    path = put(place / "loop", loop_text(place).replace(*edit))
    assert refused("validate", place, *FAST) == f"{path.resolve()}: {words}"
    assert not (place / "validation").exists()


@pytest.mark.parametrize("text", ["", "[]", "[" * 100_000, '{"format": 1, "digest": {}}', HALF])
def test_what_is_no_loop_at_all_is_refused(place: Path, text: str) -> None:
    path = put(place / "loop", text)
    assert refused("validate", place, *FAST).startswith(f"{path.resolve()}: ")


def test_what_belongs_to_other_strokes_ink_or_brushes_is_left_out_with_the_reason(place: Path) -> None:
    for changes, words in (
        ({"source": Source.LOOPBACK}, "its source is loopback rig, not imported photographs"),
        ({"original_sha256": "3" * 64}, f"it belongs to another recording of {place.name}"),
    ):
        put(place / "loop", loop_text(place, **changes))
        assert words in said("validate", place, *FAST, left_out=True)
    for changes, words in (
        ({"source": Source.LOOPBACK}, "its source is loopback rig, not imported photographs"),
        ({"brush": "goat hair"}, "it was written with another brush, goat hair"),
    ):
        characters(place.parent.parent / "written", **changes)
        assert words in said("validate", place, *FAST, left_out=True)
    report, _ = report_of(place)
    assert report.loops == report.written == ()


@pytest.mark.parametrize("beside", ["sessions/presses/written", "written"])
def test_table_3_has_the_papers_rows_beside_and_figure_13(place: Path, beside: str) -> None:
    characters(place.parent.parent / beside)
    assert "Table 3: 字" in said("validate", place, *FAST, left_out=True)
    report, page = report_of(place)
    like, strict = (table_3(report.written[0], "字", key[0]) for key in (NORMAL, STRICT))
    assert {row.label: None if row.paper is None else row.paper.csim[2] for row in like} == {
        "simulated, ink = 1": 94.58,
        "robot writing, ink = 1": 93.59,
        "another writing, ink = 1": None,
        "the plan, ink = 1": None,
        "simulated, paper = 1": 94.58,
        "robot writing, paper = 1": 93.59,
    }
    assert all(row.paper is None for row in strict)
    assert page.count("Figure 13") >= 2


def test_an_edited_table_3_or_another_picture_is_refused(place: Path) -> None:
    path = characters(place / "written")
    text = path.read_text()
    path.write_text(text.replace('"字"', '"子"'))
    assert "was edited: its digest does not match its contents" in refused("validate", place, *FAST)
    path.write_text(text)
    path.with_name("figure-13.png").write_bytes(PICTURE + b" ")
    assert "is not the picture of written.json beside it: its SHA-256 differs" in refused("validate", place, *FAST)


def test_what_others_wrote_is_escaped(place: Path) -> None:
    bad = "<img src=x onerror=alert(1)>{{ 7 * 7 }}"
    named = dict.fromkeys(("model", "session", "command", "software"), bad)
    characters(place / "written", table_3=table_of(bad, bad), **named)
    put(place / "loop", loop_text(place, command=bad, software=bad, model=bad))
    assert "Table 3: <img" in said("validate", place, *FAST, left_out=True)  # a terminal shows it as it is
    _, page = report_of(place)
    assert "<img src=x" not in page
    assert page.count("&lt;img src=x onerror=alert(1)&gt;{{ 7 * 7 }}") > 8
