"""The picture pages of the commands: each is one file that fetches nothing, labelled, and fits every window."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import numpy as np
import pytest

from brushloop.calibrate.compare import Tone
from brushloop.calibrate.loop import Pair, write_loop
from brushloop.calibrate.report import chart_uri, picture_grid, printable, source_label, source_note
from brushloop.calibrate.writing.compare import Character, WritingComparison, write_written
from brushloop.sessions.messages import decode_gray
from brushloop.sessions.records import Source
from tests.browser import BROWSER, content_widths_px
from tests.calibrate.given import CALIBRATION, loop_record, opened, pair_scores, photographed, plan_of
from tests.calibrate.simulated_rigs import boards
from tests.command import said
from tests.photographed import imported_presses

TWIN = "simulated bristle bundle (twin of 2026-03-02-grid-01)"
WIDTHS_PX = (390, 800, 1200, 1600)
MAX_BYTES = 3 * 1024 * 1024
MADE = "simulated Table-2 brush (made to agree with the paper's Table 2: no evidence for the model)"


def run(*arguments: object) -> str:
    """Run a command; returns the page that it names at the end."""
    return Path(said(*arguments).rpartition("Page: ")[2]).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """A page of every command but `train` (tests/model/test_generator.py), by the command's name."""
    folder = tmp_path_factory.mktemp("pages")
    presses = imported_presses(folder, [(11.0, 0.0), (15.0, 0.0)])
    [shot] = boards(0, 1)
    session = photographed(folder / "2026-03-02-board-01", shot.board, [shot.image], sheet_mm=shot.sheet_mm)
    return {
        "calibrate": run("calibrate", session),
        "loop": _loop(folder),
        "write": _written(folder),
        "fit": run("fit", presses),
        "validate": _validated(presses),
    }


def _validated(session: Path) -> str:
    """The page of a session that is fitted."""
    said("validate", session, "--no-held-out")
    return (session / "validation" / "report.html").read_text(encoding="utf-8")


def _loop(folder: Path) -> str:
    """The page of presses of three conditions, of which one was not pressed again."""
    scores = pair_scores()
    pairs = [Pair(press, press, press.images) for press in scores.presses]
    sessions = opened("grid", folder, TWIN), opened("replay", folder, TWIN)
    record = loop_record("grid", "ab", refused=(("a-r02", "was not pressed again"), ("x<u>", "is blank")))
    return write_loop(record, sessions, pairs, scores, folder / "loop").read_text(encoding="utf-8")


def _written(folder: Path) -> str:
    """The page of one character, written twice."""
    plan = plan_of()
    [figure] = plan.figures
    character = Character(figure, {f"zi-r{k}": dict.fromkeys(Tone, figure.wanted) for k in range(2)})
    written = WritingComparison(opened("write-01", folder, TWIN, CALIBRATION), plan, [character])
    return write_written(written, folder / "written", "brushloop write").read_text(encoding="utf-8")


def test_a_page_is_one_labelled_file_without_scripts_that_fetches_nothing(pages: dict[str, str]) -> None:
    for name, page in pages.items():
        assert len(page.encode()) <= MAX_BYTES, name
        foreign = r"(?:src|href)=\"(?!data:|#|[\w.-]+\.(?:png|csv|json|parquet|txt)\")[^\"]*\"|<script|@import|<u>"
        assert re.findall(foreign, page) == [], name
        assert '<span class="source">' in page
        for figure in re.findall(r"<img[^>]*>", page):
            assert re.search(r'alt="[^"]{3}', figure), f"{name}: {figure[:80]} has no text for a screen reader"
        for drawing in re.findall(r"<svg[^>]*>", page):
            assert 'role="img"' in drawing, name
            assert "aria-label" in drawing, name


def test_the_page_of_a_calibration_draws_every_corner_with_its_residual(pages: dict[str, str]) -> None:
    page = pages["calibrate"]
    [corners] = re.findall(r"(\d+) corners lie", page)
    assert page.count('class="arrow"') == int(corners) > 100
    assert 'class="sheet-edge"' in page
    assert "simulated brush, ink and camera" in page
    assert "2026-03-02-board-01" in page


def test_the_page_of_a_fit_draws_both_outlines_over_the_ink_of_each_condition(pages: dict[str, str]) -> None:
    page = pages["fit"]
    assert page.count('class="fitted" d="M') == page.count('class="published" d="M') == 2
    assert "H 11 mm, α 0° · 1 press · CSIM" in page
    assert "held out" in page
    assert "imported photographs" in page


def test_a_page_of_a_twin_says_whose_twin_on_every_figure(pages: dict[str, str]) -> None:
    for name in ("loop", "write"):
        assert '<span class="source">loopback rig, brush twin of 2026-03-02-grid-01</span>' in pages[name]
        assert pages[name].count("brush twin of 2026-03-02-grid-01") > 5
    assert "a-r02: was not pressed again" in pages["loop"]
    assert "x&lt;u&gt;: is blank" in pages["loop"]


def test_the_remark_of_a_described_brush_is_part_of_the_label_and_that_of_any_other_is_its_source() -> None:
    remark = "brush made to agree with the paper's Table 2: no evidence for the model"
    assert source_label(Source.LOOPBACK, [MADE, MADE]) == f"loopback rig, {remark}"
    assert source_label(Source.LOOPBACK, [f"{MADE}, R = 6 mm, L = 48 mm"]) == f"loopback rig, {remark}"
    assert source_note(Source.LOOPBACK, MADE).endswith(f"not a result on paper, {remark}")
    assert source_label(Source.LOOPBACK, ["simulated bristle bundle, seed 1"]) == "loopback rig"
    assert source_label(Source.REAL, ["Langhao brush (12 mm)"]) == "real capture"
    assert source_note(Source.REAL, "Langhao brush (12 mm)") == source_note(Source.REAL)


def test_a_chart_draws_what_its_font_has_and_a_question_mark_for_the_rest() -> None:
    assert printable("left\t\x1b[31m 字 α $x$") == r"left??[31m ? α \$x\$"
    figure, [[axis]] = picture_grid(1, 1, (3.0, 2.0), "字 $x$")
    axis.plot([0.0, 5.0, 10.0], [1.0, np.nan, 100.0])
    picture = decode_gray(base64.b64decode(chart_uri(figure).partition(",")[2]), "chart")
    assert picture.min() < 100 < picture.max()


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_every_page_fits_a_telephone_and_a_wide_screen_and_the_browser_has_nothing_to_say(
    pages: dict[str, str], tmp_path: Path
) -> None:
    sizes, errors = content_widths_px(pages, WIDTHS_PX, tmp_path)
    assert errors == []
    assert {where: taken for where, taken in sizes.items() if taken > where[1]} == {}
    assert len(sizes) == len(pages) * len(WIDTHS_PX)
