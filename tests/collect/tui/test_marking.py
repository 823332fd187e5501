"""`b`: the newest capture is bad, or good after all."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.tui.app import OperatorApp
from brushloop.sessions.recording import remarks_of
from tests.collect.tui.fake import FakeEngine, full_picture


def at(folder: Path, **changes: object) -> Snapshot:
    return replace(full_picture(), folder=str(folder), **changes)  # type: ignore[arg-type]


async def test_b_marks_the_last_capture_and_takes_it_back(tmp_path: Path) -> None:
    engine = FakeEngine(at(tmp_path))
    last = engine.now.last
    assert last is not None
    app = OperatorApp(engine)
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("b")
        remark = remarks_of(tmp_path)[last.still]
        assert (remark.stroke_id, remark.bad) == (last.press.stroke_id, True)
        await pilot.press("b")
        assert not remarks_of(tmp_path)[last.still].bad


async def test_b_says_nothing_of_a_capture_that_does_not_count_nor_once_the_run_is_over(tmp_path: Path) -> None:
    now = at(tmp_path)
    assert now.last is not None
    for silent in (
        replace(now, last=replace(now.last, kept=False)),
        replace(now, last=None),
        at(tmp_path, state=State.DONE),
    ):
        app = OperatorApp(FakeEngine(silent))
        async with app.run_test(size=(120, 40)) as pilot:
            await pilot.press("b")
        assert remarks_of(tmp_path) == {}


async def test_a_disk_that_refuses_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    app = OperatorApp(FakeEngine(at(tmp_path / "gone")))
    notices: list[str] = []
    monkeypatch.setattr(app, "notify", lambda message, **_options: notices.append(message))
    async with app.run_test(size=(120, 40)) as pilot:
        await pilot.press("b")
    [notice] = notices
    assert "gone" in notice
