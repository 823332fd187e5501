"""The fixtures that exports share with the tests of sessions, and a session of presses: small, with a blank capture."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.photographed import imported_presses
from tests.sessions.conftest import closed, make, out, photos, run, store  # noqa: F401 - fixtures of the exports

CONDITIONS = [(11.0, 0.0), (11.0, 10.0), (15.0, 5.0), (20.0, 0.0), (20.0, 10.0)]


@pytest.fixture(scope="session")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten presses of five conditions, and a blank capture. Nobody writes into it."""
    under = tmp_path_factory.mktemp("sessions")
    return imported_presses(under, CONDITIONS * 2, blank=True, origin="<script>alert(1)</script>")
