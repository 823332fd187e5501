"""Real photographs, where they are: what their ink is called. They are drags, and nothing was tuned to them."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from bench.quality_photographs import INK, WHITENED, judge, named, rows
from brushloop.collect.rig.config_quality import QualityConfig

DATA = Path(__file__).parents[4] / "shared" / "data" / "frida_bigbrush_tilt_16x20"
pytestmark = pytest.mark.skipif(not DATA.is_dir(), reason="the folder of real photographs is not here")


def test_the_blank_photograph_is_called_blank() -> None:
    [blank] = [row for row in rows(DATA) if row["file"] == "png/120.png"]
    assert named(judge(DATA, blank, WHITENED)) == "blank"


def test_the_ink_of_most_strokes_is_called_sound_and_none_blank() -> None:
    inked = [row for row in rows(DATA)[::12] if row["file"] != "png/120.png"]
    called = Counter(named(judge(DATA, row, WHITENED), INK) for row in inked)
    assert called["blank"] == 0
    assert called["sound"] > 0.5 * called.total(), called


def test_a_whitened_photograph_is_refused_as_overexposed_unless_the_limit_is_lifted() -> None:
    assert named(judge(DATA, rows(DATA)[0], QualityConfig())) == "exposure"
