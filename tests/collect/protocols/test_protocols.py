"""Every kind of protocol: each planned stroke exactly once, under an id and keys that no process or sheet changes;
few strokes that span the grid, and patches of the sheet that are used once."""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.config import ProtocolConfig, load_protocol
from brushloop.collect.protocols.kinds import (
    DrawnStroke,
    FewStrokesConfig,
    Figure,
    GridConfig,
    ListConfig,
    PressRow,
    WriteConfig,
)
from brushloop.collect.protocols.steps import MARKING, CaptureStep, PressStep, Step, StepKind, press_of
from brushloop.collect.rig.config import PaperConfig
from brushloop.collect.rig.paper import Sheet
from brushloop.collect.walk import as_planned
from brushloop.sessions.events import Condition, Press

EXAMPLES = Path(__file__).parents[3] / "examples"

heights = st.integers(1, 200).map(lambda v: v / 10)
tilts = st.integers(0, 60).map(lambda v: v / 2)
names = st.text(st.sampled_from("abcXYZ019-_.~永"), min_size=1, max_size=8).filter(lambda s: s[0] not in ".-~")
seeds = st.none() | st.integers(0, 99)
points = st.integers(2, 6).map(lambda n: tuple((10.0 + 3.0 * k, 20.0, 5.0 + k, 1.0 * k, 10.0 * k) for k in range(n)))


def some(kind: type[Any], **fields: Any) -> st.SearchStrategy[tuple[Any, ...]]:
    """A few of them, each with a name of its own if they have names."""
    name = next((name for name in ("stroke_id", "name") if name in fields), None)
    return st.lists(
        st.builds(kind, **fields), min_size=1, max_size=8, unique_by=id if name is None else lambda v: getattr(v, name)
    ).map(tuple)


def several(kind: type[Any], name: str, **fields: Any) -> st.SearchStrategy[Any]:
    """Protocols of a kind, in one to three rounds, shuffled or not."""
    return st.builds(kind, kind=st.just(name), repeats=st.integers(1, 3), seed=seeds, **fields)


protocols: st.SearchStrategy[ProtocolConfig] = st.one_of(
    several(
        GridConfig,
        "grid",
        depths_mm=st.lists(heights, min_size=1, max_size=5, unique=True),
        tilts_deg=st.lists(tilts, min_size=1, max_size=4, unique=True),
        board_every=st.none() | st.integers(1, 9),
    ),
    several(ListConfig, "list", presses=some(PressRow, depth_mm=heights, tilt_deg=tilts)),
    several(ListConfig, "list", of=names, presses=some(PressRow, stroke_id=names, depth_mm=heights, tilt_deg=tilts)),
    several(
        WriteConfig,
        "write",
        cell_mm=st.just((60.0, 60.0)),
        figures=some(Figure, name=names, strokes=some(DrawnStroke, points=points)),
    ),
)


def run(config: ProtocolConfig, patch: int = 7) -> list[Step]:
    """All steps, every mark having gone to the same patch."""
    generator, found = config.steps(), list[Step]()
    try:
        step = next(generator)
        while True:
            found.append(step)
            step = generator.send(as_planned(step, 0, patch))
    except StopIteration:
        return found


@given(protocols)
def test_every_planned_stroke_is_dipped_for_marked_and_captured_exactly_once(config: ProtocolConfig) -> None:
    plan, walked = config.planned(), run(config)
    ids = [stroke.stroke_id for stroke in plan]
    assert len(set(ids)) == len(ids)
    assert [press.stroke_id for s in walked if s.kind in MARKING and (press := press_of(s))] == ids
    assert [s.press.stroke_id for s in walked if isinstance(s, CaptureStep)] == ids
    assert Counter(s.kind for s in walked)[StepKind.DIP] == len(ids)
    assert [stroke.index for stroke in plan] == list(range(len(plan)))
    assert len({step.key for step in walked}) == len(walked)
    size = len(config.round(1))
    rounds = [Counter(stroke.condition for stroke in plan[k : k + size]) for k in range(0, len(plan), size)]
    assert rounds == [rounds[0]] * config.repeats, "rounds stay whole"
    again = type(config).model_validate_json(config.model_dump_json())
    assert again == config
    assert [step.key for step in run(again)] == [step.key for step in walked], "a dump changes no key"


def test_keys_tell_steps_apart_and_are_the_same_in_every_process_as_is_the_order() -> None:
    """Where these change, a session that is open is not gone on with by the next version."""
    config = GridConfig(kind="grid", depths_mm=[11.0, 15.0], tilts_deg=[0.0, 5.0], repeats=1, seed=1)
    ids = [stroke.stroke_id for stroke in config.planned()]
    assert ids == ["H15-a5-r01", "H11-a0-r01", "H15-a0-r01", "H11-a5-r01"]
    keys = [step.key[:8] for step in run(config)]
    assert keys[:5] == ["3151a9d3", "6e3abc46", "e6b62adf", "5fcba0e0", "edc00d96"]
    press = Press(stroke_id="a", condition=Condition(depth_mm=11.0, tilt_deg=5.0))
    step = PressStep(3, press)
    assert step.key != PressStep(4, press).key
    assert step.key != PressStep(3, press, dwell_s=1.0).key
    steeper = press.model_copy(update={"condition": Condition(depth_mm=11.0, tilt_deg=6.0)})
    assert step.key != PressStep(3, steeper).key
    measured = press.model_copy(update={"reached_mm": 10.9, "dip_to_touch_s": 1.2})
    assert CaptureStep(3, measured).key == CaptureStep(3, press).key, "what was measured does not change what was asked"


def test_board_views_come_after_every_so_many_strokes_and_not_at_the_end() -> None:
    config = GridConfig(kind="grid", depths_mm=[11.0], tilts_deg=[0.0], repeats=6, board_every=2)
    walked = run(config)
    kinds = [step.kind for step in walked if step.kind in (StepKind.BOARD, StepKind.PRESS)]
    assert "".join(kind[0] for kind in kinds) == "bppbppbpp"
    again = [step.kind for step in walked if step.run_scoped]
    assert again == [StepKind.ZERO_TOUCH, StepKind.BOARD], "each process touches the paper and looks at the board first"


def test_a_list_keeps_its_order_and_names_and_shuffles_only_for_a_seed() -> None:
    listed = load_protocol(EXAMPLES / "protocol-list.toml")
    assert isinstance(listed, ListConfig)
    as_written = listed.model_copy(update={"seed": None}).planned()
    assert [s.stroke_id for s in as_written][:4] == ["light", "002-H13-a5-r01", "slow", "004-H17-a10-r01"]
    assert [s.stroke_id for s in as_written][5] == "light-r02"
    assert [s.dwell_s for s in as_written][:3] == [0.2, 0.2, 0.5]
    assert [s.stroke_id for s in listed.planned()] != [s.stroke_id for s in as_written]


# Grids and their sheets

GRID: dict[str, Any] = {"depths_mm": [11.0, 13.0, 15.0, 17.0, 20.0], "tilts_deg": [0.0, 5.0, 10.0]}


def test_patches_tile_the_sheet_without_overlap() -> None:
    sheet = Sheet(PaperConfig(origin_mm=(460.0, -110.0), touch_z_mm=120.0, size_mm=(244.0, 172.0)))
    tiles = {(2.0 + 40.0 * column, 2.0 + 24.0 * row, 40.0, 24.0) for column in range(6) for row in range(7)}
    assert {sheet.patch(index).rect_mm for index in range(sheet.capacity)} == tiles


# Few strokes


def pressed(strokes: int) -> list[tuple[float, float]]:
    few = FewStrokesConfig(kind="few-strokes", **GRID, strokes=strokes)
    return [(p.condition.depth_mm, p.condition.tilt_deg) for p in few.planned()]


def test_the_first_four_presses_are_the_corners_of_the_grid_and_more_continue_the_same_order() -> None:
    assert set(pressed(4)) == {(11.0, 0.0), (11.0, 10.0), (20.0, 0.0), (20.0, 10.0)}
    assert pressed(9) == pressed(12)[:9]
    assert len(set(pressed(15))) == 15
    assert pressed(20)[15:] == pressed(5)


# Files: what cannot be used is one line that names file, line, field and range; nothing huge or odd is read

GRID_FILE = 'kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\n'
LIST = 'kind = "list"\nfile = "p.csv"\n'
REPLAY = 'kind = "list"\nof = "old"\nfile = "p.csv"\n'
WRITE = 'kind = "write"\ncell_mm = [60.0, 60.0]\n[[figures]]\nname = "a"\n[[figures.strokes]]\n'
POINTS = "points = [[10.0, 10.0, 5.0, 0.0, 0.0], [20.0, 10.0, 5.0, 0.0, 0.0]]\n"


def load(folder: Path, protocol: str, csv: str | bytes | None = None):
    (folder / "protocol.toml").write_text(protocol, encoding="utf-8")
    if csv is not None:
        (folder / "p.csv").write_bytes(csv if isinstance(csv, bytes) else csv.encode())
    return load_protocol(folder / "protocol.toml")


@pytest.mark.parametrize(
    ("protocol", "csv", "message"),
    [
        (LIST, "depth_mm\n11\nx\n", r"p.csv: line 3: depth_mm: .* valid number \(given: 'x'\)$"),
        (LIST, "depth_mm\n1_1\n", r"p.csv: line 2: depth_mm: .* valid number \(given: '1_1'\)$"),
        (LIST, "depth_mm,tilt_deg\n11,31\n", r"p.csv: line 2: tilt_deg: .* less than or equal to 30 \(given: 31.0\)$"),
        (LIST, "depth_mm\nnan\n", r"line 2: depth_mm: .* valid number"),
        (LIST, "depth_mm,tilt_deg\n11\n", r"line 2: 1 cells under 2 columns"),
        (LIST, "depth_mm,tilt\n11,5\n", r"p.csv: line 2: tilt: unknown field; did you mean tilt_deg"),
        (LIST, "depth_mm,depth_mm\n5,5\n", r"line 1: the column 'depth_mm' occurs twice"),
        (LIST, "depth_mm\n", r"p.csv: has no rows"),
        (LIST, b"depth_mm\n\xff\n", r"p.csv: is not UTF-8 at byte 9"),
        (LIST, 'depth_mm\n"11', r"p.csv: line 2: is not CSV"),
        (LIST, "depth_mm,stroke_id\n11,a/b\n", r"line 2: stroke_id: a name may not .*slashes"),
        (LIST, "depth_mm,stroke_id\n11,\x1b[2J\n", r"line 2: stroke_id: .*control"),
        (LIST + "repeats = 2\n", "depth_mm,stroke_id\n11,a\n12,a-r02\n", r"'a-r02' occurs twice"),
        (LIST, None, r"p.csv: no such file"),
        (LIST.replace("p.csv", "../p.csv"), None, r"protocol.toml: file: must be the name, without folder"),
        (LIST + "presses = []\n", "depth_mm\n11\n", r"presses and file are both given"),
        (REPLAY, "stroke_id,depth_mm\na,11\n,12\n", r"every press that repeats one of old needs its stroke_id"),
        (REPLAY.replace("old", "a b"), "stroke_id,depth_mm,tilt_deg\na,11,0\n", r"of: a name may not contain spaces"),
        (WRITE + 'file = "p.csv"\n' + POINTS, None, r"figures.0.strokes.0: points and file are both given"),
        (WRITE + 'file = "p.csv"\n', "x_mm,y_mm,depth_mm\n1,1,3\n70,1,3\n", r"the point \[70, 1\] lies outside"),
        (WRITE + 'file = "p.csv"\n', "x_mm,y_mm,depth_mm\n1,1,3\n1.5,1,3\n", r"point 2 is less than 1 mm from"),
        (WRITE + POINTS.replace("5.0,", "-1.0,"), None, r"nothing would be drawn"),
        (WRITE + POINTS.replace("20.0", "nan"), None, r"figures.0.strokes.0.points.1.0: "),
        ('kind = "teapot"\n', None, r"kind: 'teapot' is not one of 'grid', 'few-strokes', 'list', 'write'$"),
        (GRID_FILE + "hurry = 3\n", None, r"hurry: unknown field; known are board_every, .*, depths_mm, .*, kind$"),
        (GRID_FILE.replace("11.0", "11.0, 11.0"), None, r"depths_mm: 11.0 occurs twice"),
        ("x = 1\n", None, r"protocol.toml: kind: is missing: one of 'grid', 'few-strokes', "),
        ("kind = ", None, r"is not TOML"),
        ("x = " + "[" * 5000, None, r"is not TOML"),
    ],
)  # fmt: skip
def test_a_protocol_that_cannot_be_used_is_one_line(
    tmp_path: Path, protocol: str, csv: str | bytes | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        load(tmp_path, protocol, csv)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 600


def test_rows_become_part_of_the_protocol_and_an_empty_cell_is_left_out(tmp_path: Path) -> None:
    listed = load(tmp_path, LIST, "\ufeffheight_mm , tilt_deg,stroke_id\r\n 11.5,,deep永\r\n\r\n12,3,\r\n")
    assert isinstance(listed, ListConfig)
    rows = [(row.depth_mm, row.tilt_deg, row.stroke_id) for row in listed.presses]
    assert rows == [(11.5, 0, "deep永"), (12, 3, None)]
    assert '"depth_mm":11.5' in listed.model_dump_json()
    assert load(tmp_path, LIST, "depth_mm\n13\n").model_dump_json() != listed.model_dump_json()


def test_rows_and_bytes_are_bounded_and_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"p.csv: line 10002: more than 10000 rows"):
        load(tmp_path, LIST, "depth_mm\n" + "11\n" * 10_001)
    with pytest.raises(ConfigError, match=r"p.csv: is larger than 8388608 bytes"):
        load(tmp_path, LIST, "depth_mm\n" + "11\n" * 3_000_000)
    with pytest.raises(ConfigError, match=r"protocol.toml: is larger than 8388608 bytes"):
        load(tmp_path, LIST + "#" * 9_000_000, "depth_mm\n11\n")
    (tmp_path / "p.csv").unlink()
    os.mkfifo(tmp_path / "p.csv")
    with pytest.raises(ConfigError, match=r"p.csv: is not a file"):
        load(tmp_path, LIST)
    with pytest.raises(ConfigError, match=r"is not a file"):
        load_protocol(tmp_path)


def test_strokes_and_points_are_bounded_over_the_whole_protocol(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"12000 strokes with all repeats; at most 10000"):
        load(tmp_path, LIST + "repeats = 1000\n", "depth_mm\n" + "11\n" * 12)
    rows = "".join(f"{1 + k % 50},{1 + k // 50 % 50},5\n" for k in range(900))
    figures = "".join(f'[[figures]]\nname = "f{k}"\n[[figures.strokes]]\nfile = "p.csv"\n' for k in range(12))
    with pytest.raises(ConfigError, match=r"10800 points in all; at most 10000"):
        load(tmp_path, f'kind = "write"\ncell_mm = [60.0, 60.0]\n{figures}', "x_mm,y_mm,depth_mm\n" + rows)


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_stands_in_the_files_is_read_or_refused(tmp_path: Path, rubbish: bytes) -> None:
    for csv in (rubbish, b"depth_mm,stroke_id\n" + rubbish):
        with contextlib.suppress(ConfigError):
            load(tmp_path, LIST, csv)
    (tmp_path / "protocol.toml").write_bytes(rubbish)
    with pytest.raises(ConfigError):
        load_protocol(tmp_path / "protocol.toml")
