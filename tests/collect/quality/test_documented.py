"""docs/quality.md names every field of `[quality]` with its default."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.rig.config_touch import QualityConfig

PAGE = (Path(__file__).parents[3] / "docs" / "quality.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(("field", "default"), QualityConfig().model_dump().items())
def test_the_page_gives_the_default_of_every_field(field: str, default: float | bool) -> None:
    shown = f"{default:g}" if isinstance(default, float) else str(default).lower()
    assert f"`{field}` {shown}" in PAGE
