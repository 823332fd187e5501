"""The label that every table and figure carries."""

from __future__ import annotations

from brushloop.calibrate.report import printable, source_label, source_note
from brushloop.sessions.records import Source

MADE = "simulated bristle bundle, paper (made to agree with the paper's Table 2: no evidence for the model)"


def test_the_remark_of_a_described_brush_is_part_of_the_label() -> None:
    remark = "brush made to agree with the paper's Table 2: no evidence for the model"
    assert source_label(Source.LOOPBACK, [MADE, MADE]) == f"loopback rig, {remark}"
    assert source_label(Source.LOOPBACK, [f"{MADE}, R = 6 mm, L = 48 mm"]) == f"loopback rig, {remark}"
    assert source_note(Source.LOOPBACK, MADE).endswith(f"not a result on paper, {remark}")


def test_the_label_of_any_other_brush_is_its_source() -> None:
    assert source_label(Source.LOOPBACK, ["simulated bristle bundle, seed 1"]) == "loopback rig"
    assert source_label(Source.REAL, ["Langhao brush (12 mm)"]) == "real capture"
    assert source_note(Source.REAL, "Langhao brush (12 mm)") == source_note(Source.REAL)


def test_a_plot_shows_a_question_mark_for_what_no_font_draws() -> None:
    assert printable("left\t\x1b[31m.png") == "left??[31m.png"
