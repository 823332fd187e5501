"""Remarks lie beside a recording: the latest holds, none is overwritten, a torn one hurts nobody."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.events import Remark
from brushloop.sessions.recording import REMARKS_NAME, add_remark, remarks_of


def test_the_latest_remark_on_a_capture_holds_and_the_earlier_ones_stay(tmp_path: Path) -> None:
    assert remarks_of(tmp_path) == {}
    add_remark(tmp_path, Remark(t_ns=1, still=4, stroke_id="H13-a0-r01", bad=True, note="墨 ran"))
    add_remark(tmp_path, Remark(t_ns=2, still=7, stroke_id="H13-a0-r02", bad=False, note="pale"))
    add_remark(tmp_path, Remark(t_ns=3, still=4, stroke_id="H13-a0-r01", bad=False, note="good after all"))
    assert remarks_of(tmp_path)[4] == Remark(t_ns=3, still=4, stroke_id="H13-a0-r01", bad=False, note="good after all")
    assert remarks_of(tmp_path)[7].note == "pale"
    assert "ran" in (tmp_path / REMARKS_NAME).read_text(encoding="utf-8")


def test_a_line_that_a_crash_cut_off_is_set_aside(tmp_path: Path) -> None:
    add_remark(tmp_path, Remark(t_ns=1, still=4, stroke_id="a", bad=True, note=""))
    with (tmp_path / REMARKS_NAME).open("ab") as file:
        file.write(b'{"t_ns":2,"event":"rem')
    assert set(remarks_of(tmp_path)) == {4}
    add_remark(tmp_path, Remark(t_ns=3, still=5, stroke_id="b", bad=True, note=""))
    assert set(remarks_of(tmp_path)) == {4, 5}


def test_damage_is_named(tmp_path: Path) -> None:
    add_remark(tmp_path, Remark(t_ns=1, still=4, stroke_id="a", bad=True, note=""))
    path = tmp_path / REMARKS_NAME
    path.write_bytes(path.read_bytes().replace(b'"still":4', b'"still":5'))
    with pytest.raises(SessionDamaged, match="does not match its CRC"):
        remarks_of(tmp_path)
