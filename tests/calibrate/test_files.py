"""What may be written where: nothing that was recorded or is being read is ever overwritten."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from brushloop.__main__ import app
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import check_target
from brushloop.sessions.errors import InputError


def test_a_target_has_the_ending_of_what_is_written_and_is_not_what_is_read(tmp_path: Path) -> None:
    photograph, recording, folder = tmp_path / "a.png", tmp_path / "s.mcap", tmp_path / "folder.png"
    photograph.write_bytes(b"ink")
    folder.mkdir()
    check_target(tmp_path / "new.PNG", ".png", photograph, None)
    check_target(photograph, ".png")
    for path, why in ((recording, r"must end in \.png"), (photograph, "is the input"), (folder, "is a folder")):
        with pytest.raises(CalibrationError, match=why):
            check_target(path, ".png", photograph)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("write", "plan", "字", "--out", "taken/plan"), "taken: is a file"),
        (("write", "compare", "s.mcap", "--plan", "p", "--out", "taken"), "taken: is a file"),
        (("write", "learn", "s.mcap", "--plan", "p", "--out", "taken"), "taken: is a file"),
        (("repress", "compare", "s.mcap", "s.mcap", "--out", "taken/loop"), "taken: is a file"),
        (("recover", "s.mcap", "--out", "taken/recovered.csv"), "taken: is a file"),
        (("validate", "s.mcap", "--out", "taken/report"), "taken: is a file"),
        (("recover", "s.mcap", "--out", "s.mcap"), "must end in"),
        (("validate", "captures", "s.mcap", "--generator", "g.safetensors", "--out", "s.mcap"), "must end in"),
    ],
)
def test_where_it_is_to_be_written_is_looked_at_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], why: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("taken", "s.mcap"):
        (tmp_path / name).write_text("kept")
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.calibrate.writing.plan.pressed", None)  # not called: it takes minutes
        ran = CliRunner().invoke(app, [*words])
    assert isinstance(ran.exception, InputError | CalibrationError)
    assert why in str(ran.exception)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"taken": "kept", "s.mcap": "kept"}
