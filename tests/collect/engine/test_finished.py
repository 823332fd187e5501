"""What is printed when a session is finished: where its recording lies, and the next command."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.start import CollectRequest, collect, ending
from tests.runs import wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab


def test_the_recording_and_what_comes_next(tmp_path: Path) -> None:
    folder = tmp_path / "grid-01"
    recorded = f"recorded: {folder}/grid-01.mcap"
    assert ending(folder, "grid") == [recorded, f"next:     brushloop calibrate {folder}"]
    (folder / "calibration").mkdir(parents=True)
    assert ending(folder, "list") == [recorded, f"next:     brushloop validate {folder}"]
    assert ending(folder, "calibration") == [recorded]


def test_it_is_printed_after_the_screen_too(
    wired_lab: Lab, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = wired_lab
    lab.write_protocol("[11.0]", "[0.0]")
    monkeypatch.setattr("brushloop.collect.tui.app.run_app", lambda app: (app.engine.start(), wait_for_end(app.engine)))
    folder, left_out = collect(
        CollectRequest(lab.folder / "rig.toml", lab.folder / "protocol.toml", lab.sessions, on_screen=True)
    )
    assert [folder] == list(lab.sessions.iterdir())
    assert left_out == 0
    assert capsys.readouterr().out.splitlines() == ending(folder, "grid")
    assert (folder / f"{folder.name}.mcap").is_file()
