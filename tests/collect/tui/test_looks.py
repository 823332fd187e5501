"""What the run screen looks like, compared with accepted pictures (`--snapshot-update` takes new ones)."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from textual.pilot import Pilot

from collect.snapshot import Snapshot
from collect.tui.app import RunApp
from tests.collect.tui.fake import DONE, FAILED, PAUSED, FakeEngine, picture

SMALL, LARGE = (80, 24), (120, 40)


@pytest.fixture(autouse=True)
def colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)


async def settle(pilot: Pilot[None]) -> None:
    await pilot.pause(0.25)


@pytest.mark.parametrize(
    ("now", "size"),
    [
        pytest.param(picture(), SMALL, id="running"),
        pytest.param(PAUSED, SMALL, id="paused"),
        pytest.param(FAILED, SMALL, id="failed"),
        pytest.param(DONE, SMALL, id="done"),
        pytest.param(picture(), LARGE, id="running-large"),
    ],
)
def test_run_screen(snap_compare: Callable[..., bool], now: Snapshot, size: tuple[int, int]) -> None:
    assert snap_compare(RunApp(FakeEngine(now)), terminal_size=size, run_before=settle)
