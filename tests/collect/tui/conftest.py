from __future__ import annotations

from unittest.mock import AsyncMock

import pytest


@pytest.fixture(autouse=True)
def model_so_far(monkeypatch: pytest.MonkeyPatch) -> AsyncMock:
    """What the fit beside a run says, nothing at first: no process is started."""
    fit = AsyncMock(return_value=None)
    monkeypatch.setattr("brushloop.collect.tui.so_far.model_so_far", fit)
    return fit
