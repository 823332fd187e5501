"""Show and list: what is in a session and which sessions there are, for people and as JSON."""

import json

import pytest

from brushloop.sessions.events import CaptureResult, PressResult, StepKind
from brushloop.sessions.imports import ImportOptions
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.recording import mark_bad_or_good
from brushloop.sessions.show import Summary, details, summaries
from tests.command import brushloop

PROTOCOL = '{"kind":"grid","depths_mm":[13.0,15.0],"tilts_deg":[5.0],"repeats":2}'


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    """No line of what is printed is broken."""
    monkeypatch.setenv("COLUMNS", "200")


def press(make, store, stroke_id, depth_mm, patch):
    made = make.press(stroke_id, depth_mm, sheet=store.state.sheet, patch=patch)
    make.take(store, f"press {stroke_id}", [], PressResult(press=made), patch)
    number = store.state.begun
    shown = [make.still(number), make.stroke(number, stroke_id=stroke_id, depth_mm=depth_mm, tilt_deg=5.0)]
    make.take(store, f"capture {stroke_id}", shown, CaptureResult(press=made, still=number))


@pytest.fixture
def collected(make, tmp_path):
    """Two strokes of four that were planned, one press that was stopped, one that the process did not survive."""
    store = make.store(tmp_path / make.header.session_id, protocol=PROTOCOL, robot="aubo_i5", robot_firmware="24")
    press(make, store, "H13-a5-r01", 13.0, 0)
    store.void(store.begin("v", StepKind.PRESS, patches=(1,), press=make.press("H15-a5-r01")), "stopped")
    press(make, store, "H15-a5-r01", 15.0, 2)
    store.fresh_sheet()
    store.begin("k", StepKind.PRESS, patches=(0,), press=make.press("H13-a5-r02")).writer.abandon()
    yield store
    store.release()


def test_an_open_session_shows_what_is_done_cut_and_next(collected):
    shown = details(collected.folder)
    assert (shown.state, shown.strokes, shown.planned) == ("open", 2, 4)
    assert shown.finished == {"press": 2, "capture": 2}
    assert shown.void == [
        "press H15-a5-r01, attempt 1: stopped",
        "press H13-a5-r02, attempt 1: the process ended during the step",
    ]
    assert shown.next == "press H13-a5-r02"
    assert shown.conditions == {"H 13 mm, alpha 5 deg": "1 of 2", "H 15 mm, alpha 5 deg": "1 of 2"}
    assert shown.sheets == {1: [0, 1, 2], 2: [0]}
    assert shown.header.robot == "aubo_i5"
    assert shown.messages == {"/step": 8, "/camera/still": 2, "/stroke": 2}


def test_what_is_marked_bad_is_distinguished_from_what_counts(collected):
    [first, _] = [capture.still for capture in collected.state.results(CaptureResult)]
    assert mark_bad_or_good(collected.folder, first, "H13-a5-r01", 1)
    shown = details(collected.folder)
    assert (shown.strokes, shown.marked_bad) == (1, 1)
    assert shown.conditions == {"H 13 mm, alpha 5 deg": "0 of 2", "H 15 mm, alpha 5 deg": "1 of 2"}
    assert "1 of 4 planned, and 1 marked bad" in brushloop("sessions", "show", collected.folder).stdout


def test_a_closed_session_and_its_file_agree(collected):
    final = collected.close()
    of_folder, of_file = details(collected.folder), details(final)
    assert (of_folder.state, of_folder.next, of_folder.file) == ("closed", "", final.name)
    assert of_folder.conditions == of_file.conditions
    assert of_folder.messages == of_file.messages
    assert (of_file.state, of_file.strokes) == ("recording", 2)


def test_the_command_prints_it_and_json_holds_all_of_it(collected):
    ran = brushloop("sessions", "show", collected.folder)
    assert ran.returncode == 0
    condition, running = "H 13 mm, alpha 5 deg: 1 of 2", "press H13-a5-r02 (under way"
    for words in ("2 of 4 planned", "3 patches used", condition, running, "goat"):
        assert words in ran.stdout
    as_json = json.loads(brushloop("sessions", "show", collected.folder, "--json").stdout)
    assert as_json["sheets"] == {"1": [0, 1, 2], "2": [0]}


@pytest.fixture
def root(make, tmp_path, out, photos, run):
    """`sessions/` with one session of every state, and two folders that are none."""
    root = out.parent
    make.photographs(photos, {"file": "a.png"})
    run(ImportOptions("drag", px_per_mm=10.0))
    make.session(root / "2026-01-02-grid-01", 3, closed=True)
    make.session(root / "2026-01-02-grid-02", 1)
    (root / "notes").mkdir()
    (root / "readme.txt").write_text("no session")
    return root


def test_every_session_is_reported_in_one_line(root):
    assert list(summaries(root)) == [
        Summary("2026-01-02-grid-01", "closed", "loopback rig", 3, "2026-01-02-grid-01.mcap"),
        Summary("2026-01-02-grid-02", "open", "", 1, ""),
        Summary("from-elsewhere", "imported", "imported photographs", 1, "from-elsewhere.mcap"),
    ]
    printed = brushloop("sessions", "list", root).stdout
    assert all(row.session_id in printed and row.file in printed for row in summaries(root))


def test_a_damaged_session_hides_no_other(root):
    merged = root / "2026-01-02-grid-01" / "2026-01-02-grid-01.mcap"
    merged.write_bytes(merged.read_bytes()[:-9])
    journal = root / "2026-01-02-grid-02" / JOURNAL_NAME
    journal.write_text("{oops\n" + journal.read_text())
    assert [(row.session_id, row.state, row.file) for row in summaries(root)] == [
        ("2026-01-02-grid-01", "damaged", merged.name),
        ("2026-01-02-grid-02", "damaged", JOURNAL_NAME),
        ("from-elsewhere", "imported", "from-elsewhere.mcap"),
    ]
