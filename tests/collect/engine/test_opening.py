"""A session that was begun with another configuration: what differs is named field by field, and the way back."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from brushloop.collect.engine import engine
from brushloop.collect.engine.open_or_resume import CollectRequest, Opening, find_resumable, put_in_sheet
from brushloop.collect.errors import ConfigError
from brushloop.collect.protocols.steps import StepKind
from brushloop.collect.tui.start_screen import SessionBrowser
from brushloop.collect.walk import walk
from brushloop.drivers.host import Clock
from brushloop.sessions.events import CaptureResult, Condition, Press, PressResult
from brushloop.sessions.records import Header, Source
from brushloop.sessions.store import SessionStore

GRID = 'kind = "grid"\ndepths_mm = [11.0, 20.0]\ntilts_deg = [0.0]\nrepeats = 2\n'
WAY_OUT = (
    "Resume it with --config sessions/grid-01/rig.toml --protocol sessions/grid-01/protocol.toml. Each must be beside "
    "the files that it names, and the environment variables the same. Or start a new session with --new."
)


@pytest.fixture
def lab(rig_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Both files and an open session that was begun with them, seen from the folder that holds all of it."""
    monkeypatch.chdir(tmp_path)
    Path("protocol.toml").write_text(GRID)
    begin()
    return tmp_path


def begin(session_id: str = "grid-01") -> None:
    header = Header(session_id=session_id, source=Source.LOOPBACK, software="brushloop 0")
    SessionStore.create(Path("sessions") / session_id, header, opening().snapshots, Clock().now_ns).release()


def opening(config: Path = Path("rig.toml"), **options: Any) -> Opening:
    return Opening.load(CollectRequest(config, Path("protocol.toml"), **options))


def kinds(opened: Opening) -> set[StepKind]:
    return {walked.step.kind for walked in walk(opened.rig, opened.protocol)}


def edit(name: str, old: str, new: str) -> None:
    text = Path(name).read_text()
    assert old in text
    Path(name).write_text(text.replace(old, new))


def refused() -> list[str]:
    with pytest.raises(ConfigError) as caught:
        find_resumable(opening())
    return str(caught.value).splitlines()


def test_what_did_not_change_is_gone_on_with_unless_its_old_values_cannot_be_read(lab: Path) -> None:
    edit("rig.toml", "port = 30004", "port = 31004")  # where a device is may change
    edit("rig.toml", "[paper]", "# measured again\n[paper]")
    assert find_resumable(opening()) == Path("sessions/grid-01")
    Path("sessions/grid-01/rig.effective.json").write_text("{")
    assert refused()[1] == "rig.toml: its earlier content is missing or damaged"


@pytest.mark.parametrize("trouble", ["damaged", "linked"])
def test_an_unreadable_session_stands_in_no_others_way(lab: Path, trouble: str) -> None:
    old = lab / "sessions" / "old"
    old.mkdir()
    if trouble == "damaged":
        (old / "journal.jsonl").write_bytes(b"no line\n")
    else:
        shutil.copy(lab / "sessions" / "grid-01" / "journal.jsonl", lab)
        (old / "journal.jsonl").symlink_to(lab / "journal.jsonl")
    assert find_resumable(opening()) == Path("sessions/grid-01")
    shutil.rmtree(lab / "sessions" / "grid-01")
    [line] = refused()
    assert "One of them cannot be resumed: sessions/old/journal.jsonl: " in line
    assert "--sheet 1" in line
    assert find_resumable(opening(sheet=1)) is None


def test_what_differs_is_named_by_file_field_or_variable_and_so_is_the_way_back(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit("rig.toml", "cell_mm = [40.0, 24.0]", "cell_mm = [80.0, 80.0]")
    edit("rig.toml", "radius_mm = 6.0", "radius_mm = 5.0")
    edit("protocol.toml", "repeats = 2", "repeats = 3")
    monkeypatch.setenv("BRUSHLOOP_PAPER__TOUCH_Z_MM", "121.0")
    assert '"touch_z_mm": 121.0' in opening().snapshots["rig.effective.json"]
    first, *lines, way_out = refused()
    assert (first, way_out) == ("sessions/grid-01: was begun with another configuration:", WAY_OUT)
    assert sorted(lines) == [
        "protocol.toml: repeats: 2 -> 3",
        "rig.toml: brush.radius_mm: 6.0 -> 5.0",
        "rig.toml: paper.cell_mm: [40.0, 24.0] -> [80.0, 80.0]",
        "rig.toml: paper.touch_z_mm: 120.03 -> 121.0 (by BRUSHLOOP_PAPER__TOUCH_Z_MM)",
    ]
    # and what it says is true
    monkeypatch.delenv("BRUSHLOOP_PAPER__TOUCH_Z_MM")
    old = Path("sessions/grid-01")
    shutil.copy(old / "protocol.toml", "protocol.toml")
    assert find_resumable(opening(old / "rig.toml")) == old


def test_a_changed_row_of_a_side_file_is_named_by_its_number(lab: Path) -> None:
    Path("p.csv").write_text("depth_mm\n11\n12\n")
    Path("protocol.toml").write_text('kind = "list"\nfile = "p.csv"\n')
    (lab / "sessions/grid-01").rename(lab / "elsewhere")
    begin()
    Path("p.csv").write_text("depth_mm\n11\n13\n")
    assert refused()[1:] == ["protocol.toml: presses.1.depth_mm: 12.0 -> 13.0", WAY_OUT]
    Path("p.csv").write_text("depth_mm\n11\n")
    assert refused()[1] == "protocol.toml: presses.1.depth_mm: 12.0 -> left out"


def test_where_hardware_may_move_the_rig_is_checked_first_unless_it_is_switched_off(lab: Path) -> None:
    assert StepKind.SELF_CHECK in kinds(opening(armed=True))
    assert find_resumable(opening(armed=True)), "a session goes on with --arm that was begun without"
    assert StepKind.SELF_CHECK not in kinds(opening())
    edit("rig.toml", 'host = "127.0.0.1"', 'host = "192.168.1.7"')  # to be armed on the screen
    assert StepKind.SELF_CHECK in kinds(opening())
    edit("rig.toml", "[motion]", "[self_check]\nenabled = false\n\n[motion]")
    assert StepKind.SELF_CHECK not in kinds(opening(armed=True))


def test_the_start_screen_resumes_each_session_with_its_own_protocol(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another protocol lies in the folder, and a newer session is open."""
    begin("grid-02")
    assert find_resumable(opening()) == Path("sessions/grid-02"), "the newest of those that it could be"
    edit("protocol.toml", "repeats = 2", "repeats = 3")
    monkeypatch.setattr(engine, "engine_for", engine_for := Mock())
    browser = SessionBrowser()
    for session_id in ("grid-01", "grid-02"):
        browser.engine(session_id)
        [resumed] = engine_for.call_args.args
        assert find_resumable(resumed) == Path("sessions") / session_id
        assert resumed.protocol.kind == "grid"


def test_a_sheet_stays_in_until_each_stroke_on_it_is_photographed() -> None:
    press = Press(stroke_id="first", condition=Condition(depth_mm=13.0, tilt_deg=5.0))
    results: dict[type, list[Any]] = {PressResult: [PressResult(press=press)], CaptureResult: []}
    state = SimpleNamespace(sheet=0, results=results.__getitem__)
    sheets: list[str] = []
    store: Any = SimpleNamespace(state=state, fresh_sheet=lambda: sheets.append("fresh"))
    with pytest.raises(ConfigError, match="first is pressed on sheet 1 but not photographed"):
        put_in_sheet(store, 2)
    results[CaptureResult].append(CaptureResult(press=press, still=1))
    put_in_sheet(store, 1)
    assert not sheets
    put_in_sheet(store, 2)
    assert sheets == ["fresh"]
