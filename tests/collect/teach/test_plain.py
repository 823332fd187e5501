"""The first day in lines: a wait for a line ends when the arm is stopped."""

from __future__ import annotations

import asyncio
import os
import signal
from pathlib import Path

import pytest

from collect import cli_rig
from collect.errors import CollectAborted
from collect.teach.plain import PlainGuide


async def test_lines_are_read_one_by_one(tmp_path: Path) -> None:
    read, write = os.pipe()
    guide = PlainGuide(tmp_path, descriptor=read)
    os.write(write, b"192.0.2.7\n26\n")
    assert await guide.text("Address", "") == "192.0.2.7"
    assert await guide.number("Squares", "", 3, 50, None) == 26.0
    os.close(write)
    os.close(read)


def test_a_question_that_is_stopped_does_not_wait_for_enter(tmp_path: Path) -> None:
    read, write = os.pipe()

    async def stopped() -> None:
        asked = asyncio.create_task(PlainGuide(tmp_path, descriptor=read).text("Address", ""))
        await asyncio.sleep(0.05)
        asked.cancel()
        with pytest.raises(asyncio.CancelledError):
            await asked

    asyncio.run(stopped())  # would wait for the reading thread
    os.close(write)
    os.close(read)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_arm_before_the_process_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    stopped: list[str] = []

    async def moving(*_: object) -> None:
        os.kill(os.getpid(), number)
        try:
            await asyncio.sleep(60.0)
        except asyncio.CancelledError:
            stopped.append("the arm")
            raise

    monkeypatch.setattr(cli_rig, "_taught", moving)
    with pytest.raises(CollectAborted, match="the same command resumes"):
        cli_rig._teach(tmp_path / "rig.toml", None, plain=True, arm=True)
    assert stopped == ["the arm"]
