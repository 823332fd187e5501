"""The list of sessions: closed, imported, open or damaged, without reading a single still."""

import pytest
from typer.testing import CliRunner

from brushloop.sessions.cli import app
from brushloop.sessions.errors import InputError
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.show import Summary, summaries


@pytest.fixture
def root(make, tmp_path, out, photos, run):
    """`sessions/` with one session of every state, and two folders that are none."""
    root = out.parent
    make.photographs(
        photos,
        {"file": "a.png", "px_per_mm": "10", "depth_mm": "13", "tilt_deg": "5"}
        | {"start_x_px": "1", "start_y_px": "1"},
    )
    run()
    for name, strokes in (("2026-01-02-grid-01", 3), ("2026-01-02-grid-02", 1)):
        store = make.store(root / name)
        for number in range(strokes):
            make.perform(store, f"stroke {number}")
        if strokes == 3:
            store.close()
        store.release()
    (root / "notes").mkdir()
    (root / "readme.txt").write_text("no session")
    return root


def test_every_session_is_reported_in_one_line(root):
    assert list(summaries(root)) == [
        Summary("2026-01-02-grid-01", "closed", "loopback rig", 3, "2026-01-02-grid-01.mcap"),
        Summary("2026-01-02-grid-02", "open", "", 1, ""),
        Summary("from-elsewhere", "imported", "imported photographs", 1, "from-elsewhere.mcap"),
    ]


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


def test_a_session_that_crashed_before_closed_is_open_though_its_file_is_there(root):
    journal = root / "2026-01-02-grid-01" / JOURNAL_NAME
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:-1]))
    assert next(summaries(root)) == Summary("2026-01-02-grid-01", "open", "", 3, "")


def test_a_folder_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="is not a folder of sessions"):
        list(summaries(tmp_path / "gone"))


def test_the_command_lists_them(root):
    ran = CliRunner(env={"COLUMNS": "200"}).invoke(app, ["list", str(root)])
    assert ran.exit_code == 0
    for word in ("2026-01-02-grid-01", "closed", "open", "imported photographs", "from-elsewhere.mcap"):
        assert word in ran.output
