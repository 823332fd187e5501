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
    photograph = tmp_path / "a.png"
    photograph.write_bytes(b"ink")
    check_target(tmp_path / "new.PNG", ".png", photograph, None)
    check_target(photograph, ".png")
    for path, why in ((tmp_path / "s.mcap", r"must end in \.png"), (photograph, "is the input")):
        with pytest.raises(CalibrationError, match=why):
            check_target(path, ".png", photograph)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(CalibrationError, match="is a folder"):
        check_target(tmp_path / "folder.png", ".png")


@pytest.mark.parametrize(
    "words",
    [
        ("write", "plan", "字", "--out", "taken/plan"),
        ("write", "plan", "字", "--out", "taken"),
        ("write", "compare", "s.mcap", "--plan", "p", "--out", "taken"),
        ("write", "learn", "s.mcap", "--plan", "p", "--out", "taken"),
        ("loop", "compare", "s.mcap", "s.mcap", "--out", "taken/loop"),
        ("invert", "s.mcap", "--out", "taken/recovered.csv"),
        ("validate", "s.mcap", "--out", "taken/report"),
    ],
)
def test_where_it_is_to_be_written_is_looked_at_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file")
    with monkeypatch.context() as patch:
        patch.setattr("brushloop.calibrate.writing.plan.pressed", None)  # not called: it takes minutes
        ran = CliRunner().invoke(app, [*words])
    assert isinstance(ran.exception, InputError)
    assert str(ran.exception) == f"{tmp_path / 'taken'}: is a file; a folder is needed"
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    "words",
    [
        ("invert", "{s}", "--out", "{s}"),
        ("validate", "captures", "{s}", "--generator", "g.safetensors", "--out", "{s}"),
    ],
)
def test_a_recording_is_not_overwritten_by_what_comes_of_it(tmp_path: Path, words: tuple[str, ...]) -> None:
    recording = tmp_path / "s.mcap"
    recording.write_bytes(b"recorded")
    ran = CliRunner().invoke(app, [word.format(s=recording) for word in words])
    assert ran.exit_code != 0
    assert isinstance(ran.exception, CalibrationError)
    assert "must end in" in str(ran.exception)
    assert recording.read_bytes() == b"recorded"
    assert [path.name for path in tmp_path.iterdir()] == ["s.mcap"]
