"""A protocol that cannot be used is one line that names file, line, field and range; nothing huge or odd is read."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols import config as protocol_config
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.kinds import GridConfig, ListConfig, WriteConfig

EXAMPLES = Path(__file__).parents[3] / "examples"
LIST = 'kind = "list"\nfile = "p.csv"\n'
REPLAY = 'kind = "replay"\nof = "old"\nfile = "p.csv"\n'
WRITE = 'kind = "write"\ncell_mm = [60.0, 60.0]\n[[figures]]\nname = "a"\n[[figures.strokes]]\n'
POINTS = "points = [[10.0, 10.0, 5.0, 0.0, 0.0], [20.0, 10.0, 5.0, 0.0, 0.0]]\n"
CALIBRATION = 'kind = "calibration"\n'


def load(folder: Path, protocol: str, csv: str | bytes | None = None):
    (folder / "protocol.toml").write_text(protocol, encoding="utf-8")
    if csv is not None:
        (folder / "p.csv").write_bytes(csv if isinstance(csv, bytes) else csv.encode())
    return load_protocol(folder / "protocol.toml")


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_examples_are_valid(path: Path) -> None:
    assert load_protocol(path).kind in path.stem or isinstance(load_protocol(path), GridConfig)


@pytest.mark.parametrize(
    ("protocol", "csv", "message"),
    [
        (LIST, "depth_mm\n11\nx\n", r"p.csv: line 3: depth_mm: .* valid number \(given: 'x'\)$"),
        (LIST, "depth_mm\n1_1\n", r"p.csv: line 2: depth_mm: .* valid number \(given: '1_1'\)$"),
        (LIST, "depth_mm,dwell_s\n11,1_0\n", r"p.csv: line 2: dwell_s: .* valid number \(given: '1_0'\)$"),
        (LIST, "depth_mm,tilt_deg\n11,31\n", r"p.csv: line 2: tilt_deg: .* less than or equal to 30 \(given: 31.0\)$"),
        (LIST, "depth_mm\nnan\n", r"line 2: depth_mm: .* valid number"),
        (LIST, "depth_mm\ninf\n", r"line 2: depth_mm: .* valid number"),
        (LIST, "depth_mm\n0\n", r"line 2: depth_mm: .* greater than 0"),
        (LIST, "depth_mm,dwell_s\n11,61\n", r"line 2: dwell_s: .* less than or equal to 60"),
        (LIST, "depth_mm,tilt_deg\n,5\n", r"line 2: depth_mm: Field required"),
        (LIST, "depth_mm,tilt_deg\n11\n", r"line 2: 1 cells under 2 columns"),
        (LIST, "depth_mm,tilt\n11,5\n", r"p.csv: line 2: tilt: unknown field; did you mean tilt_deg"),
        (LIST, "tilt_deg\n5\n", r"line 2: depth_mm: Field required"),
        (LIST, "depth_mm,depth_mm\n5,5\n", r"line 1: the column 'depth_mm' occurs twice"),
        (LIST, "depth_mm\n", r"p.csv: has no rows"),
        (LIST, "", r"p.csv: has no rows"),
        (LIST, b"depth_mm\n\xff\n", r"p.csv: is not UTF-8 at byte 9"),
        (LIST, 'depth_mm\n"11', r"p.csv: line 2: is not CSV"),
        (LIST, "depth_mm,stroke_id\n11,a/b\n", r"line 2: stroke_id: a name has no .*slashes"),
        (LIST, "depth_mm,stroke_id\n11,\x1b[2J\n", r"line 2: stroke_id: .*control"),
        (LIST, "depth_mm,stroke_id\n11,a\n12,a\n", r"presses: 'a' occurs twice"),
        (LIST, None, r"p.csv: no such file"),
        (LIST.replace("p.csv", "../p.csv"), None, r"protocol.toml: file: must be the plain name of a file next to it"),
        (LIST.replace("p.csv", "/etc/passwd"), None, r"file: must be the plain name"),
        (LIST.replace('"p.csv"', "3"), None, r"file: must be the plain name"),
        (LIST + "presses = []\n", "depth_mm\n11\n", r"presses: a file is named too"),
        ('kind = "list"\n', None, r"protocol.toml: presses: Field required"),
        ('kind = "list"\npresses = []\n', None, r"presses: .*at least 1"),
        (REPLAY, "stroke_id,depth_mm\na,11\n", r"line 2: tilt_deg: Field required"),
        (REPLAY, "stroke_id,depth_mm,tilt_deg\na,11,-0.2\n", r"line 2: tilt_deg: .* greater than or equal to 0"),
        (REPLAY.replace("old", "a b"), "stroke_id,depth_mm,tilt_deg\na,11,0\n", r"of: a name has no spaces"),
        (WRITE + 'file = "p.csv"\n' + POINTS, None, r"figures.0.strokes.0.points: a file is named too"),
        (WRITE + 'file = "p.csv"\n', "x_mm,y_mm,depth_mm\n1,1,3\n70,1,3\n", r"the point \[70, 1\] lies outside"),
        (WRITE + 'file = "p.csv"\n', "x_mm,y_mm,depth_mm\n1,1,3\n1.5,1,3\n", r"point 2 is less than 1 mm from"),
        (WRITE + 'file = "p.csv"\n', "x_mm,y_mm,depth_mm\n1,1,3\n", r"figures.0.strokes.0.points: .*at least 2"),
        (WRITE + POINTS.replace("5.0,", "-1.0,"), None, r"nothing would be drawn"),
        (WRITE + POINTS.replace("20.0", "nan"), None, r"figures.0.strokes.0.points.1.0: "),
        (WRITE.replace('"a"', '"a b"') + POINTS, None, r"figures.0.name: .*spaces"),
        ('kind = "write"\ncell_mm = [60.0, 60.0]\nfigures = 3\n', None, r"figures: "),
        (CALIBRATION + "touches_mm = [[1.0, 1.0], [1.0, 1.0]]\n", None, r"touches_mm: \(1.0, 1.0\) occurs twice"),
        (CALIBRATION + "board_every = 3\n", None, r"use board_views"),
        (CALIBRATION + "wait_after_dip_s = 3.0\n", None, r"wait_after_dip_s: this protocol has no dips"),
        (LIST + "wait_after_dip_s = 601\n", "depth_mm\n11\n", r"wait_after_dip_s: .*600 \(given: 601\)$"),
        ('kind = "teapot"\n', None, r"kind: .*'grid', 'few-strokes', 'list', 'replay', 'write', 'calibration'"),
        ("x = 1\n", None, r"protocol.toml: kind: "),
        ('kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nspeed = 3\n', None, r"speed: unknown field"),
        ('kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 0\n', None, r"repeats: .*1 \(given: 0\)$"),
        ("kind = ", None, r"is not TOML"),
        ("x = " + "[" * 5000, None, r"is not TOML"),
    ],
)  # fmt: skip
def test_a_protocol_that_cannot_be_used_is_one_line(
    tmp_path: Path, protocol: str, csv: str | bytes | None, message: str
) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        load(tmp_path, protocol, csv)
    assert refused.value.exit_code == 2
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 600


def test_rows_become_part_of_the_protocol_and_an_empty_cell_is_left_out(tmp_path: Path) -> None:
    listed = load(tmp_path, LIST, "\ufeffheight_mm , tilt_deg,stroke_id\r\n 11.5,,deep\r\n\r\n12,3,\r\n")
    assert isinstance(listed, ListConfig)
    assert [(row.depth_mm, row.tilt_deg, row.stroke_id) for row in listed.presses] == [
        (11.5, 0, "deep"),
        (12, 3, None),
    ]
    assert '"depth_mm":11.5' in listed.model_dump_json()
    (tmp_path / "p.csv").write_text("depth_mm\n13\n")
    assert load_protocol(tmp_path / "protocol.toml").model_dump_json() != listed.model_dump_json()


def test_rows_and_bytes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"p.csv: line 10002: more than 10000 rows"):
        load(tmp_path, LIST, "depth_mm\n" + "11\n" * 10_001)
    monkeypatch.setattr(protocol_config, "MAX_TABLE_BYTES", 1000)
    with pytest.raises(ConfigError, match=r"p.csv: is larger than 1000 bytes"):
        load(tmp_path, LIST, "depth_mm\n" + "11\n" * 1000)
    monkeypatch.setattr(protocol_config, "MAX_PROTOCOL_BYTES", 100)
    with pytest.raises(ConfigError, match=r"protocol.toml: is larger than 100 bytes"):
        load(tmp_path, LIST + "#" * 200, "depth_mm\n11\n")


def test_strokes_and_points_are_bounded_over_the_whole_protocol(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"12000 strokes with repeats, at most 10000"):
        load(tmp_path, LIST + "repeats = 1000\n", "depth_mm\n" + "11\n" * 12)
    rows = "".join(f"{1 + k % 50},{1 + k // 50 % 50},5\n" for k in range(900))
    figures = "".join(f'[[figures]]\nname = "f{k}"\n[[figures.strokes]]\nfile = "p.csv"\n' for k in range(12))
    with pytest.raises(ConfigError, match=r"10800 points in all, at most 10000"):
        load(tmp_path, f'kind = "write"\ncell_mm = [60.0, 60.0]\n{figures}', "x_mm,y_mm,depth_mm\n" + rows)


def test_what_is_no_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "p.csv")
    with pytest.raises(ConfigError, match=r"p.csv: is not a file"):
        load(tmp_path, LIST)
    with pytest.raises(ConfigError, match=r"is not a file"):
        load_protocol(tmp_path)


def test_names_of_a_list_may_not_meet_those_of_its_own_repeats(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'a-r02' occurs twice"):
        load(tmp_path, LIST + "repeats = 2\n", "depth_mm,stroke_id\n11,a\n12,a-r02\n")


def test_chinese_names_are_names(tmp_path: Path) -> None:
    assert isinstance(load(tmp_path, WRITE.replace('"a"', '"永"') + POINTS), WriteConfig)


@given(st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_whatever_stands_in_the_files_is_read_or_refused(tmp_path: Path, rubbish: bytes) -> None:
    for csv in (rubbish, b"depth_mm,stroke_id\n" + rubbish):
        with contextlib.suppress(ConfigError):
            load(tmp_path, LIST, csv)
    (tmp_path / "protocol.toml").write_bytes(rubbish)
    with pytest.raises(ConfigError):
        load_protocol(tmp_path / "protocol.toml")
