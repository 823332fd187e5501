"""A host clock that is set back in mid-session: one process does not notice; the lines of the next one show it."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.errors import CollectAborted
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.recording import Recording
from brushloop.sessions.verify import verify_session
from tests.collect.durability.conftest import the_session
from tests.journal_lines import read_lines
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab

HOUR_S = 3600

pytestmark = pytest.mark.soak


class WallClock:
    """What the operating system reports as the time of day."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.ahead_s = 0
        seconds, nanoseconds = time.time, time.time_ns
        monkeypatch.setattr(time, "time", lambda: seconds() + self.ahead_s)
        monkeypatch.setattr(time, "time_ns", lambda: nanoseconds() + self.ahead_s * 1_000_000_000)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> WallClock:
    return WallClock(monkeypatch)


@pytest.mark.parametrize("jump_s", [-HOUR_S, HOUR_S])
def test_a_clock_that_is_set_within_a_step_and_between_two_moves_no_stamp(
    lab: Lab, wall: WallClock, jump_s: int
) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.step.startswith("press"))
    wall.ahead_s += jump_s
    until(engine, lambda now: now.strokes_done == 1)
    engine.pause()
    until(engine, lambda now: now.step == "paused")
    wall.ahead_s += jump_s
    engine.resume()
    wait_for_end(engine)

    folder = the_session(lab)
    lines = list(read_lines(folder / JOURNAL_NAME))
    times_ns = [line["t_ns"] for line in lines]
    assert times_ns == sorted(times_ns)
    stamps_ns = [message.log_time for _, _, message in McapFile(folder / f"{folder.name}.mcap").sound().messages()]
    assert max(stamps_ns) - min(stamps_ns) < 60e9
    assert engine.snapshot().elapsed_s < 60.0
    assert verify_session(folder).sound


def test_a_clock_that_was_set_back_between_two_processes_shows_and_reorders_nothing(lab: Lab, wall: WallClock) -> None:
    lab.write_protocol("[11.0, 13.0, 15.0]")
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 2)
    engine.stop()
    with pytest.raises(CollectAborted):
        wait_for_end(engine)

    wall.ahead_s -= HOUR_S
    again = lab.engine()
    again.start()
    wait_for_end(again)
    folder = the_session(lab)
    lines = list(read_lines(folder / JOURNAL_NAME))
    [_, resumed] = [number for number, line in enumerate(lines) if line["event"] == "process"]
    back_s = (lines[resumed - 1]["t_ns"] - lines[resumed]["t_ns"]) / 1e9
    assert back_s == pytest.approx(HOUR_S, abs=60.0)
    results = [line["result"] for line in lines if line["event"] == "done"]
    captured = [result["press"]["stroke_id"] for result in results if result["kind"] == "capture"]
    assert [capture.stroke.stroke_id for capture in Recording(folder).captures()] == captured
    assert len(set(captured)) == 3
    assert verify_session(folder).sound
