"""`--rig` as an operator has it: a pytest of its own, on a terminal or without one, against a loopback rig."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import AsyncMock, Mock

import pytest

from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import LoopbackRig
from tests.contract import conftest
from tests.rigs import in_thread
from tests.waiting import PATIENCE_S

ROOT = Path(__file__).parents[2]
# One test that moves and two that do not.
CHOSEN = "a_move_arrives or who_answers or comes_often"


def test_it_says_what_it_will_do_and_after_a_yes_it_moves(tmp_path: Path):
    path, output = tmp_path / "rig.toml", ""
    ours, theirs = pty.openpty()
    with in_thread(LoopbackRig(SimConfig(rate=5.0, force_sensor=False, ink_device="none"))) as (rig, _):
        path.write_text(rig.toml(), encoding="utf-8")
        chosen = ["tests/contract", "--rig", str(path), "-k", CHOSEN, "-p", "no:cacheprovider", "--color=no"]
        terminal = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
        run = subprocess.Popen([sys.executable, "-m", "pytest", *chosen], cwd=ROOT, start_new_session=True, **terminal)
        os.close(theirs)
        try:
            # Linux reports by an error that the other end has gone.
            with contextlib.suppress(OSError):
                while conftest.QUESTION not in output:
                    output += os.read(ours, 65536).decode()
                assert "passed" not in output, "asks before the first test"
                os.write(ours, b"y\n")
                while True:
                    output += os.read(ours, 65536).decode()
            assert run.wait(PATIENCE_S) == 0, output
        finally:
            run.kill()
            run.wait()
            os.close(ours)
    assert "3 passed" in output
    for expected in (
        r"1 tests are about to power an arm and move it",
        r"robot +aubo_i5 \(brushloop-loopback\).*: the loopback rig, simulated",
        r"address +127\.0\.0\.1:\d+, framing sof",
        r"tip +x 250\.0, y -230\.0, z \d+\.0 mm",
        r"box +straight up by at most 5 mm from where the tip stands, and back",
        r"step +5 mm at most, at 10 mm/s",
    ):
        assert re.search(expected, output), expected


@pytest.mark.parametrize(
    ("answer", "refused"),
    [("y", ""), ("YES", ""), (" yes ", ""), ("", "was 'no'"), ("n", "was 'n'"), ("yesterday", "was 'yesterday'")],
)
@pytest.mark.parametrize("on_terminal", [True, False])
def test_only_a_yes_on_a_terminal_lets_it_move_and_nothing_else_is_skipped(
    monkeypatch: pytest.MonkeyPatch, answer: str, refused: str, on_terminal: bool
):
    terminal = Mock(spec=io.StringIO, **{"isatty.return_value": on_terminal, "readline.return_value": f"{answer}\n"})
    monkeypatch.setattr(sys, "stdin", terminal)
    monkeypatch.setattr(conftest, "_look", AsyncMock(return_value=(None, None, None)))
    monkeypatch.setattr(conftest, "_announcement", Mock(return_value=""))
    monkeypatch.setattr(conftest, "sole_driver", lambda _host, _port: contextlib.nullcontext())
    config = Mock(stash=pytest.Stash(), option=Mock(collectonly=False))
    config.stash[conftest.RIG] = Mock()
    moving, still = Mock(), Mock(**{"get_closest_marker.return_value": None})
    conftest.pytest_collection_modifyitems(config, [moving, still])
    reasons = [mark.args[0].kwargs["reason"] for mark in moving.add_marker.call_args_list]
    expected = refused if on_terminal else "no terminal to ask on"
    assert len(reasons) == bool(expected)
    assert all(expected in reason for reason in reasons)
    assert not still.add_marker.called


@pytest.mark.parametrize(
    ("toml", "processes", "expected"), [("name = 1", None, "rig.toml"), ("", 2, "several processes")]
)
def test_a_rig_that_cannot_be_used_is_a_usage_error(tmp_path: Path, toml: str, processes: int | None, expected: str):
    path = tmp_path / "rig.toml"
    path.write_text(toml, encoding="utf-8")
    config = Mock(spec=pytest.Config, stash=pytest.Stash(), option=Mock(numprocesses=processes))
    config.getoption.return_value = path
    with pytest.raises(pytest.UsageError, match=re.escape(expected)):
        conftest.pytest_configure(config)
