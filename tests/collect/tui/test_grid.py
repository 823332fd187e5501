"""The table of the grid fits where it can."""

from __future__ import annotations

from brushloop.collect.engine.snapshot import CellCount
from brushloop.collect.tui.panes import BAD, COMPLETE, LEFT_OUT, NEXT, NOW, grid_content
from brushloop.sessions.records import Condition
from tests.collect.tui.fake import grid_of, marked_grid


def test_tilts_go_down_where_the_width_allows() -> None:
    lines = grid_content(grid_of(5), 78).plain.splitlines()
    assert lines[0].split("  ") == ["α \\ H", "11 mm", "13 mm", "15 mm", "17 mm", "20 mm"]
    assert [line.split()[0] for line in lines[1:]] == ["0°", "5°", "10°"]
    assert lines[1].split()[1:3] == ["2/2", "✓"]
    assert len({len(line) for line in lines}) == 1


def test_depths_go_down_where_only_that_fits() -> None:
    lines = grid_content(grid_of(5, tuple(range(6, 21))), 78).plain.splitlines()
    assert len(lines) == 16
    assert lines[1].split()[:2] == ["6", "mm"]


def test_before_the_width_is_known_and_where_nothing_fits_tilts_go_down() -> None:
    for room in (0, 10):
        assert len(grid_content(grid_of(5), room).plain.splitlines()) == 4


def test_every_state_has_a_sign_as_well_as_a_colour() -> None:
    text = grid_content(marked_grid(), 78).plain
    for sign in (COMPLETE, NOW, NEXT, BAD, LEFT_OUT):
        assert text.count(sign) == (text.count("2/2") - 1 if sign is COMPLETE else 1), sign


def test_a_cell_that_is_not_planned_is_a_dash() -> None:
    cells = (CellCount(Condition(11.0, 0.0), 0, 2), CellCount(Condition(13.0, 5.0), 2, 2))
    lines = grid_content(cells, 78).plain.splitlines()
    assert lines[1].split() == ["0°", "0/2", "-"]
    assert lines[2].split() == ["5°", "-", "2/2", "✓"]
