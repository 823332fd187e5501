"""Every kind of protocol: each planned stroke exactly once, under an id and keys that no process or sheet changes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from brushloop.collect.planning.walk import as_planned
from brushloop.collect.protocols.config import ProtocolConfig, load_protocol
from brushloop.collect.protocols.kinds import (
    CalibrationConfig,
    DrawnStroke,
    Figure,
    GridConfig,
    ListConfig,
    PressRow,
    ReplayConfig,
    ReplayRow,
    WriteConfig,
)
from brushloop.collect.protocols.steps import (
    MARKING,
    CaptureStep,
    DrawStep,
    PressStep,
    Step,
    StepKind,
    TouchStep,
    press_of,
)
from brushloop.collect.rig.paper import Layout

EXAMPLES = Path(__file__).parents[3] / "examples"

heights = st.integers(1, 200).map(lambda v: v / 10)
tilts = st.integers(0, 60).map(lambda v: v / 2)
names = st.text(st.sampled_from("abcXYZ019-_.~永"), min_size=1, max_size=8).filter(lambda s: s[0] not in ".-~")
layouts = st.none() | st.builds(Layout, st.integers(1, 9), st.integers(1, 9))
seeds = st.none() | st.integers(0, 99)
points = st.integers(2, 6).map(lambda n: tuple((10.0 + 3.0 * k, 20.0, 5.0 + k, 1.0 * k, 10.0 * k) for k in range(n)))
grids = st.builds(
    GridConfig,
    kind=st.just("grid"),
    depths_mm=st.lists(heights, min_size=1, max_size=5, unique=True),
    tilts_deg=st.lists(tilts, min_size=1, max_size=4, unique=True),
    repeats=st.integers(1, 4),
    seed=st.integers(0, 99),
    board_every=st.none() | st.integers(1, 9),
)
rows = st.builds(PressRow, depth_mm=heights, tilt_deg=tilts)
lists = st.builds(
    ListConfig,
    kind=st.just("list"),
    presses=st.lists(rows, min_size=1, max_size=8).map(tuple),
    repeats=st.integers(1, 3),
    seed=seeds,
)
replays = st.builds(
    ReplayConfig,
    kind=st.just("replay"),
    of=st.just("2026-11-21-grid-01"),
    presses=st.lists(
        st.builds(ReplayRow, stroke_id=names, depth_mm=heights, tilt_deg=tilts),
        min_size=1,
        max_size=8,
        unique_by=lambda row: row.stroke_id,
    ).map(tuple),
    repeats=st.integers(1, 3),
    seed=seeds,
)
figures = st.builds(
    Figure, name=names, strokes=st.lists(st.builds(DrawnStroke, points=points), min_size=1, max_size=3).map(tuple)
)
writes = st.builds(
    WriteConfig,
    kind=st.just("write"),
    cell_mm=st.just((60.0, 60.0)),
    figures=st.lists(figures, min_size=1, max_size=3, unique_by=lambda figure: figure.name).map(tuple),
    repeats=st.integers(1, 3),
    seed=seeds,
)
protocols = st.one_of(grids, lists, replays, writes)


def run(config: ProtocolConfig, layout: Layout | None = None, patch: int = 7) -> list[Step]:
    """All steps, every mark having gone to the same patch."""
    generator, found = config.steps(layout), list[Step]()
    try:
        step = next(generator)
        while True:
            found.append(step)
            step = generator.send(as_planned(step, 0, patch))
    except StopIteration:
        return found


@given(protocols, layouts)
@settings(deadline=None)
def test_every_planned_stroke_is_dipped_for_marked_and_captured_exactly_once(
    config: ProtocolConfig, layout: Layout | None
) -> None:
    plan, walked = config.planned(layout), run(config, layout)
    ids = [stroke.stroke_id for stroke in plan]
    assert len(set(ids)) == len(ids)
    assert [press.stroke_id for s in walked if s.kind in MARKING and (press := press_of(s))] == ids
    assert [s.press.stroke_id for s in walked if isinstance(s, CaptureStep)] == ids
    assert Counter(s.kind for s in walked)[StepKind.DIP] == len(ids)
    assert sorted(stroke.index for stroke in plan) == list(range(len(plan)))
    assert len({step.key for step in walked}) == len(walked)
    assert [stroke.repeat for stroke in plan] == sorted(stroke.repeat for stroke in plan)


@given(protocols, layouts)
@settings(deadline=None)
def test_the_sheet_changes_the_order_and_never_a_key(config: ProtocolConfig, layout: Layout | None) -> None:
    there = {step.key for step in run(config, layout) if step.kind != StepKind.BOARD}
    assert there == {step.key for step in run(config) if step.kind != StepKind.BOARD}


@given(protocols)
@settings(deadline=None)
def test_what_was_dumped_is_the_whole_protocol(config: ProtocolConfig) -> None:
    again = type(config).model_validate_json(config.model_dump_json())
    assert again == config
    assert [step.key for step in run(again)] == [step.key for step in run(config)]


def test_keys_and_order_are_the_same_in_another_process() -> None:
    layout = Layout(6, 7)
    here = {path.name: [s.key for s in run(load_protocol(path), layout)] for path in EXAMPLES.glob("*.toml")}
    program = (
        "import json,sys;from pathlib import Path;sys.path.insert(0, sys.argv[1]);from test_plans import *;"
        "print(json.dumps({p.name: [s.key for s in run(load_protocol(p), Layout(6, 7))] "
        "for p in EXAMPLES.glob('*.toml')}))"
    )
    arguments = [sys.executable, "-c", program, str(Path(__file__).parent)]
    there = subprocess.run(arguments, capture_output=True, text=True, check=True).stdout
    assert json.loads(there) == here


def test_board_views_come_after_every_so_many_strokes_and_not_at_the_end() -> None:
    config = GridConfig(kind="grid", depths_mm=[11.0], tilts_deg=[0.0], repeats=6, board_every=2)
    kinds = [step.kind for step in run(config) if step.kind in (StepKind.BOARD, StepKind.PRESS)]
    assert "".join(kind[0] for kind in kinds) == "bppbppbpp"


def test_a_list_keeps_its_order_and_names_and_shuffles_only_for_a_seed() -> None:
    listed = load_protocol(EXAMPLES / "protocol-list.toml")
    assert isinstance(listed, ListConfig)
    as_written = listed.model_copy(update={"seed": None}).planned()
    assert [s.stroke_id for s in as_written][:4] == ["light", "002-H13-a5-r01", "slow", "004-H17-a10-r01"]
    assert [s.stroke_id for s in as_written][5] == "light-r02"
    assert [s.dwell_s for s in as_written][:3] == [0.2, 0.2, 0.5]
    assert [s.stroke_id for s in listed.planned()] != [s.stroke_id for s in as_written]


def test_a_replayed_stroke_is_found_by_the_one_that_it_repeats() -> None:
    config = load_protocol(EXAMPLES / "protocol-replay.toml")
    assert isinstance(config, ReplayConfig)
    assert (config.of, config.ignored_columns) == ("2026-11-21-grid-01", ("depth_sd_mm",))
    for step in run(config):
        if isinstance(step, PressStep | CaptureStep):
            assert step.press.stroke_id.rpartition("~")[0] == step.again_of
    assert {s.again_of for s in config.planned()} == {"H11-a0-r01", "H13-a5-r01", "H20-a10-r01"}


def test_a_figure_is_one_step_that_holds_its_trajectories() -> None:
    config = load_protocol(EXAMPLES / "protocol-write.toml")
    assert isinstance(config, WriteConfig)
    drawn = [step for step in run(config) if isinstance(step, DrawStep)]
    assert [step.press.stroke_id for step in drawn] == ["shi-r01", "shi-r02"]
    strokes = drawn[0].drawn.strokes
    assert [len(stroke) for stroke in strokes] == [6, 6]
    assert tuple(map(tuple, strokes[0])) == config.figures[0].strokes[0].points
    assert config.own_patch_mm == (80.0, 80.0)
    assert config.planned()[0].condition.depth_mm == 9.0


def test_a_calibration_touches_and_looks_and_leaves_no_mark() -> None:
    config = load_protocol(EXAMPLES / "protocol-calibration.toml")
    assert isinstance(config, CalibrationConfig)
    walked = run(config)
    assert config.planned() == []
    assert Counter(step.kind for step in walked) == {StepKind.ZERO_TOUCH: 1, StepKind.TOUCH: 15, StepKind.BOARD: 6}
    assert len({step.key for step in walked}) == len(walked)
    assert walked[1] == TouchStep(walked[1].index, 20.0, 20.0)
    again = [step.kind for step in walked if step.run_scoped]
    assert again == [StepKind.ZERO_TOUCH, StepKind.BOARD], "each process touches the paper and looks at the board first"
