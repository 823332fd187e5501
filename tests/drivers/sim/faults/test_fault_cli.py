"""`brushloop sim --faults --control` and `brushloop fault`, as processes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.sim.fault_client import FaultRefused, ask, request_of
from tests.waiting import PATIENCE_S, wait_until

NOTHING: dict[str, object] = {"on": None, "count": None, "id": None}


def brushloop(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "brushloop", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Path]:
    script = tmp_path / "faults.toml"
    script.write_text('[[fault]]\ndevice = "camera"\nkind = "black"\nafter_s = 1000\n')
    path = tmp_path / "control"
    command = [sys.executable, "-m", "brushloop", "sim", "--faults", str(script), "--control", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    wait_until(path.exists, "the control socket", process=process)
    yield path
    process.terminate()
    _, stderr = process.communicate(timeout=PATIENCE_S)
    assert stderr == ""
    assert not path.exists()


def test_a_script_is_served_and_a_person_breaks_more_and_mends_it(served: Path):
    [scripted] = ask(served, {"do": "list"})["hanging"]
    assert scripted["fault"] == {"device": "camera", "kind": "black", "after_s": 1000.0}

    added = brushloop("fault", served, "robot", "mute", "--on", "moveLine", "--count", "3")
    assert json.loads(added.stdout) == {"id": 2}, added.stderr
    refused = brushloop("fault", served, "robot", "loud")
    assert refused.returncode == 2
    assert refused.stderr.startswith("brushloop: kind = 'loud' is not one of robot's")
    assert refused.stderr.count("\n") == 1
    assert json.loads(brushloop("fault", served, "clear").stdout) == {"taken": 2}


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


@pytest.mark.parametrize(
    ("script", "words"),
    [('[[fault]]\ndevice = "robot"\nkind = "loud"\n', "fault.0: kind = 'loud'"), (None, "no such file")],
)
def test_a_script_that_cannot_be_used_starts_no_rig(tmp_path: Path, script: str | None, words: str):
    path = tmp_path / "faults.toml"
    if script is not None:
        path.write_text(script)
    ran = brushloop("sim", "--faults", path)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert words in ran.stderr
    assert ran.stderr.count("\n") == 1
