"""The step of the brush and its ink: what a person leaves out is asked for, and is no defect."""

from __future__ import annotations

from pathlib import Path

import pytest

from brushloop.collect.errors import CannotTeach
from brushloop.collect.teach.day import Day
from brushloop.collect.teach.steps.brush import STATION, BrushStep
from brushloop.drivers.host import HostClock


class Enter:
    """A person who has an ink station, and presses Enter when asked for its serial line."""

    async def choose(self, *_: object) -> str:
        return STATION.key

    async def text(self, _question: str, default: str) -> str:
        return default


async def test_an_ink_device_without_a_serial_line_is_refused_with_the_way_out(tmp_path: Path) -> None:
    day = Day(Enter(), tmp_path / "rig.toml", HostClock(), armed=False)  # type: ignore[arg-type]
    with pytest.raises(CannotTeach, match=r"no serial line was named\. Type its path"):
        await BrushStep()._ink(day)
