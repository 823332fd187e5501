"""Characters are read as they are, and hostile data is one line."""

from __future__ import annotations

import json
import re
from importlib.resources import files

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brushloop.model.characters.glyph import parse_glyph, parse_path, paths_of, reference
from brushloop.model.characters.plan import Patch

SQUARE = "M 100 100 L 100 300 L 300 300 L 300 100 Z"


def shipped(name: str) -> str:
    return (files("brushloop.model.characters") / "data" / f"{name}.json").read_text("utf-8")


def glyph_text(**changes: object) -> str:
    return json.dumps({"strokes": [SQUARE], "medians": [[[100, 200], [300, 200]]]} | changes)


@pytest.mark.parametrize(("name", "strokes"), [("字", 6), ("子", 3), ("永", 5)])
def test_the_shipped_characters_can_be_read(name: str, strokes: int) -> None:
    glyph = parse_glyph(shipped(name))
    assert len(glyph) == strokes
    ink = reference(glyph, Patch(50.0))
    assert 0.05 < ink.mean() < 0.3
    assert ink.max() == 1.0


def test_the_licence_is_shipped_with_them() -> None:
    text = (files("brushloop.model.characters") / "data" / "ARPHICPL.TXT").read_text("utf-8")
    assert text.startswith("ARPHIC PUBLIC LICENSE")
    assert "retain this license file (ARPHICPL.TXT) unaltered" in text


def test_an_outline_is_a_closed_loop_counter_clockwise_whichever_way_it_was_drawn() -> None:
    for path in (SQUARE, "M 100 100 L 300 100 L 300 300 L 100 300 Z", "M100,100 300,100 300,300 100,300"):
        arcs = parse_path(path, "strokes.0")
        assert np.allclose(arcs[:, 2], np.roll(arcs[:, 0], -1, axis=0))
        corners = arcs[:, 0]
        x, y = corners.T
        assert 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) == pytest.approx(200.0**2)


def test_ways_lie_on_the_patch_with_the_foot_of_the_font_at_its_margin() -> None:
    patch = Patch(70.0)
    assert patch.to_mm(np.array([[0.0, -124.0], [1024.0, 900.0]])).tolist() == [[6.0, 6.0], [64.0, 64.0]]
    for path in paths_of(parse_glyph(shipped("永")), patch, 2.0):
        assert np.all(path.half_width_mm > 0)
        steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
        assert steps.max() < 3.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "Invalid JSON"),
        ("[" * 100_000, "Invalid JSON"),
        (glyph_text(strokes=[]), "strokes: List should have at least 1 item"),
        (glyph_text(strokes=[SQUARE, SQUARE]), "medians: holds 1, expected 2"),
        (glyph_text(strokes=["M 0 0 L 5"]), "strokes.0: not an SVG path"),
        (glyph_text(strokes=["M 0 0 L 9 0 M 3 3 L 1 9 Z"]), "expected one loop"),
        (glyph_text(strokes=["M 0 0 L 1e9 0 L 0 9 Z"]), "coordinates of at most 4096"),
        (glyph_text(strokes=["M 0 0 L 9 0 Z"]), "strokes.0: encloses nothing"),
        (glyph_text(strokes=["M 0 0 " + "L 1 2 L 3 4 " * 2000]), "at most 1024 pieces"),
        (glyph_text(medians=[[[0, 0]]]), "medians.0: List should have at least 2 items"),
        (glyph_text(medians=[[[0, 0], [0, "x"]]]), "medians.0.1.1: Input should be a valid number"),
        (glyph_text(medians=[[[5, 5], [5, 5]]]), "medians.0: expected two different points"),
        (" " * 300_000, "is longer than"),
    ],
)
def test_hostile_characters_are_one_line(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        parse_glyph(text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 200


@given(st.text(alphabet="MLQCZmlqc0123456789 .,-+eE", max_size=60))
def test_any_path_is_arcs_or_an_error(path: str) -> None:
    try:
        arcs = parse_path(path, "strokes.0")
    except ValueError:
        return
    assert np.isfinite(arcs).all()
