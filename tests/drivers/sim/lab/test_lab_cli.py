"""`brushloop sim --unknown` and `brushloop hand` from the command line."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from typer.testing import CliRunner

import brushloop.__main__
from brushloop.drivers.loopback import FaultRefused
from brushloop.drivers.sim.control import live_control
from brushloop.drivers.sim.lab.lab import UnknownLab
from brushloop.drivers.sim.serve import LabRefused


def run(*arguments: str) -> str:
    result = CliRunner().invoke(brushloop.__main__.app, arguments, catch_exceptions=False)
    return result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--unknown", "3", "--trap", "loud"), r"--trap is 'loud', allowed: swapped-corner, .*cable-pulled"),
        (("--unknown", "3", "--write-rig", "rig.toml"), "--unknown: can only be combined with --trap"),
        (("--trap", "force-sign"), "--trap and --truth: need --unknown SEED"),
    ],
)
def test_options_that_do_not_go_together_are_refused(arguments: tuple[str, ...], words: str):
    with pytest.raises(LabRefused, match=words) as refused:
        run("sim", *arguments)
    assert refused.value.exit_code == 2


def test_another_file_is_not_overwritten_by_the_truth(tmp_path: Path):
    mine = tmp_path / "notes.json"
    mine.write_text("mine")
    with pytest.raises(LabRefused, match="it is not overwritten"):
        run("sim", "--unknown", "3", "--truth", str(mine))
    assert mine.read_text() == "mine"


async def test_a_person_at_the_command_line_guides_the_arm(tmp_path: Path):
    lab, socket = UnknownLab(4, rate=500.0, picture_px=(640, 480)), tmp_path / "lab.sock"
    async with live_control(lab.rig.faults, socket, lab.obey):
        said = await asyncio.to_thread(run, "hand", str(socket), "bring", "board-corner", "--corner", "lower left")
        assert said == "The tip is at the board-corner, lower left.\n"
        with pytest.raises(FaultRefused, match="to = 'moon' is not one of pin"):
            await asyncio.to_thread(run, "hand", str(socket), "bring", "moon")


async def test_nobody_is_in_a_known_rig(tmp_path: Path):
    lab, socket = UnknownLab(4, rate=500.0, picture_px=(640, 480)), tmp_path / "rig.sock"
    async with live_control(lab.rig.faults, socket):
        with pytest.raises(FaultRefused, match="there is no person here"):
            await asyncio.to_thread(run, "hand", str(socket), "bring", "pin")
