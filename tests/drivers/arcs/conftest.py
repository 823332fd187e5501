"""Waiting for an arm that cannot be seen at rest is cut short: the loopback's arm rests within a tenth of a second."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from brushloop.drivers.arcs import stopping


@pytest.fixture(autouse=True)
def impatient() -> Iterator[None]:
    # A patch of its own: `monkeypatch` would be undone after the arm is closed, and tests rely on its being before.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stopping, "CONFIRM_S", 3.5)
        yield
