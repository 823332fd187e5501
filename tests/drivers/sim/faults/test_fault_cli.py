"""`brushloop sim --control` and `brushloop fault`, as processes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from brushloop.drivers.loopback import FaultRefused, ask, request_of
from tests.waiting import PATIENCE_S, wait_until

NOTHING: dict[str, object] = {"on": None, "count": None, "id": None}


def brushloop(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "control"
    command = [sys.executable, "-m", "brushloop", "sim", "--control", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_until(path.exists, "the control socket", process=process)
    yield path
    process.terminate()
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert stderr == ""
    assert not path.exists()


def test_a_person_breaks_the_rig_and_mends_it(served: Path):
    added = brushloop("fault", served, "robot", "mute", "--on", "moveLine", "--count", "3")
    assert json.loads(added.stdout) == {"id": 1}, added.stderr
    refused = brushloop("fault", served, "robot", "loud")
    assert refused.returncode == 2
    assert refused.stderr.startswith("brushloop: kind = 'loud' is not one of robot's")
    assert refused.stderr.count("\n") == 1
    assert json.loads(brushloop("fault", served, "clear").stdout) == {"taken": 1}


def test_the_words_of_a_command_line_become_a_request():
    assert request_of("state", None, NOTHING) == {"do": "state"}
    assert request_of("clear", None, NOTHING | {"id": 3}) == {"do": "clear", "id": 3}
    wanted = {"do": "add", "fault": {"device": "robot", "kind": "mute", "on": "moveLine"}}
    assert request_of("robot", "mute", NOTHING | {"on": "moveLine"}) == wanted


@pytest.mark.parametrize(
    ("what", "kind", "options", "words"),
    [
        ("robot", None, {}, "give a device and a kind"),
        ("state", "mute", {}, "takes no kind and no options"),
        ("clear", None, {"on": "moveLine"}, "takes no kind and no option but --id"),
    ],
)
def test_words_that_do_not_go_together_are_refused(what: str, kind: str | None, options: dict[str, str], words: str):
    with pytest.raises(FaultRefused, match=words):
        request_of(what, kind, NOTHING | options)


def test_where_no_rig_answers_it_is_said_in_one_line(tmp_path: Path):
    with pytest.raises(FaultRefused, match="no rig answers here") as caught:
        ask(tmp_path / "nobody", {"do": "state"})
    assert caught.value.exit_code == 2
