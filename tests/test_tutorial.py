"""The tutorial as a reader follows it: every command that it shows, in order, in one folder."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
COMMANDS = re.findall(r"^```sh\n(.*?)^```", (ROOT / "docs/tutorial.md").read_text(encoding="utf-8"), re.M | re.S)


@pytest.mark.timeout(900)
@pytest.mark.soak  # the suite already collects, calibrates and validates in tests/test_demo.py
def test_every_command_of_the_tutorial_does_what_it_says(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    first, *others = [line for block in COMMANDS for line in block.splitlines()]
    assert first.startswith("brushloop sim")
    rig = subprocess.Popen(first.split(), cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
    try:
        while not (tmp_path / "rig.toml").exists():
            assert rig.poll() is None
            time.sleep(0.05)
        for line in others:
            # Without a terminal, collect shows a progress bar instead of the screen.
            ran = subprocess.run(line, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True)
            assert ran.returncode == 0, f"{line}\n{ran.stdout}{ran.stderr}"
    finally:
        rig.send_signal(signal.SIGINT)
        rig.wait(30)
    [session] = (tmp_path / "sessions").glob("*-grid-01")
    assert (session / "validation" / "report.html").is_file()
    assert (tmp_path / "plan.png").is_file()
    assert len(list((tmp_path / "exported" / "images").iterdir())) >= 12
