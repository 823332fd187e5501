"""The fixtures that exports share with the tests of sessions."""

from __future__ import annotations

from tests.sessions.conftest import closed, make, out, photos, run, store  # noqa: F401 - fixtures of the exports
