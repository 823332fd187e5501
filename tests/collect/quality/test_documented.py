"""docs/quality.md names every field of `[quality]` with its default and its unit."""

from __future__ import annotations

import json
import re
from pathlib import Path

from brushloop.collect.rig.config_quality import QualityConfig

DOCUMENT = Path(__file__).parents[3] / "docs" / "quality.md"
UNITS = {"_mm": "mm", "_mm2": "mm²", "_mm2_per_mm": "mm²/mm", "_deg": "deg", "_level": "gray level"}
"""What a field's name says its unit is."""


def rows() -> list[list[str]]:
    text = DOCUMENT.read_text(encoding="utf-8").split("\n## [quality]\n")[1].split("\n## ")[0]
    return [[patch.strip() for patch in line.strip("|").split("|")] for line in text.splitlines() if line[:3] == "| `"]


def test_the_table_has_every_field_in_order_with_its_default() -> None:
    defaults = {name.strip("`"): json.loads(default) for name, default, _unit, _meaning in rows()}
    assert defaults == QualityConfig().model_dump()
    assert list(defaults) == list(QualityConfig.model_fields)


def test_the_unit_is_the_one_in_the_name() -> None:
    for name, _default, unit, meaning in rows():
        ending = re.search(r"(_mm2_per_mm|_mm2|_mm|_deg|_level)`$", name)
        assert unit == (UNITS[ending[1]] if ending else ""), name
        assert meaning
