"""Screens without a terminal: what no test looks at is not drawn."""

from __future__ import annotations

from typing import Any

import pytest
from textual._compositor import Compositor


@pytest.fixture(autouse=True)
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a screen changes, nothing is drawn on the terminal that is not there: it took a third of the time.

    Whoever looks at a screen, or takes its picture, still has the whole of it drawn.
    """
    render_update = Compositor.render_update

    def rendered(compositor: Compositor, full: bool = False, **options: Any) -> Any:
        if full:
            return render_update(compositor, full, **options)
        compositor._dirty_regions.clear()
        return None

    monkeypatch.setattr(Compositor, "render_update", rendered)
