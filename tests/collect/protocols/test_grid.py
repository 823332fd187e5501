"""The grid: every patch as often as asked, in an order that does not depend on the process."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from brushloop.collect.planning.walk import as_planned
from brushloop.collect.protocols.kinds import GridConfig
from brushloop.collect.protocols.steps import CaptureStep, PressStep
from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.paper import Sheet, to_base
from brushloop.sessions.events import Condition, Press

heights = st.lists(st.integers(1, 30).map(float), min_size=1, max_size=5, unique=True)
tilts = st.lists(st.integers(0, 15).map(float), min_size=1, max_size=4, unique=True)


def config(depths_mm: list[float], tilts_deg: list[float], repeats: int, seed: int = 1) -> GridConfig:
    return GridConfig(kind="grid", depths_mm=depths_mm, tilts_deg=tilts_deg, repeats=repeats, seed=seed)


@given(heights, tilts, st.integers(1, 5), st.integers(0, 99))
def test_every_cell_is_pressed_as_often_as_asked_and_once_a_round(
    depths_mm: list[float], tilts_deg: list[float], repeats: int, seed: int
) -> None:
    planned = config(depths_mm, tilts_deg, repeats, seed).planned()
    patches = Counter(p.condition for p in planned)
    assert set(patches.values()) == {repeats}
    assert len(patches) == len(depths_mm) * len(tilts_deg)
    assert [p.repeat for p in planned] == sorted(p.repeat for p in planned)
    assert len({p.stroke_id for p in planned}) == len(planned)


def test_steps_of_a_stroke_follow_each_other_and_a_capture_belongs_to_the_cell_that_was_pressed() -> None:
    protocol = config([11.0], [0.0], 1).steps()
    kinds: list[str] = []
    step = next(protocol)
    try:
        while True:
            kinds.append(step.kind)
            step = protocol.send(as_planned(step, 0, 7))
            if isinstance(step, CaptureStep):
                assert step.press.patch == 7
    except StopIteration:
        pass
    assert kinds == ["zero_touch", "board", "dip", "press", "capture"]


def test_keys_are_stable_across_processes_and_tell_steps_apart() -> None:
    press = Press(stroke_id="a", condition=Condition(depth_mm=11.0, tilt_deg=5.0))
    step = PressStep(3, press)
    program = (
        "from brushloop.collect.protocols.steps import *; from brushloop.sessions.events import *;"
        "print(PressStep(3, Press(stroke_id='a', condition=Condition(tilt_deg=5.0, depth_mm=11.0))).key)"
    )
    other = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip()
    assert other == step.key
    assert step.key != PressStep(4, press).key
    assert step.key != PressStep(3, press, dwell_s=1.0).key
    steeper = press.model_copy(update={"condition": Condition(depth_mm=11.0, tilt_deg=6.0)})
    assert step.key != PressStep(3, steeper).key
    measured = press.model_copy(update={"reached_mm": 10.9, "dip_to_touch_s": 1.2})
    assert CaptureStep(3, measured).key == CaptureStep(3, press).key, "what was measured does not change what was asked"


def paper(**changes: object) -> PaperConfig:
    values = {"origin_mm": (460.0, -110.0), "yaw_deg": 90.0, "touch_z_mm": 120.0, "size_mm": (244.0, 172.0)}
    return PaperConfig.model_validate(values | changes)


def test_cells_tile_the_sheet_without_overlap() -> None:
    sheet = Sheet(paper())
    assert (sheet.columns, sheet.rows, sheet.capacity) == (6, 7, 42)
    corners = {sheet.patch(i).rect_mm[:2] for i in range(sheet.capacity)}
    assert len(corners) == 42
    for index in range(sheet.capacity):
        x, y, width, height = sheet.patch(index).rect_mm
        assert x >= 0.0
        assert x + width <= 244.0
        assert y >= 0.0
        assert y + height <= 172.0
        anchor_x, anchor_y = sheet.patch(index).anchor_mm
        assert x < anchor_x < x + width
        assert y < anchor_y < y + height


def test_a_used_cell_is_never_handed_out_again() -> None:
    sheet = Sheet(paper())
    used: set[int] = set()
    for _ in range(sheet.capacity):
        patch = sheet.free(used)
        assert patch.index not in used
        used.add(patch.index)


def test_paper_axes_turn_with_the_yaw() -> None:
    assert to_base(paper(), 10.0, 0.0) == (460.0, -100.0)
    x, y = to_base(paper(), 0.0, 10.0)
    assert (round(x, 9), round(y, 9)) == (450.0, -110.0)
