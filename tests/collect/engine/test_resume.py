"""How a session goes on: who resumes it on a screen is asked first; camera and board must be where they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.engine import Engine
from brushloop.collect.errors import CollectAborted, NeedsOperator, Parked
from brushloop.drivers.errors import DeviceError
from brushloop.drivers.sim.config import View
from brushloop.sessions.journal import JOURNAL_NAME
from brushloop.sessions.store import SessionStore
from tests.rigs import SMALL_VIEW
from tests.runs import until, wait_for_end

if TYPE_CHECKING:
    from tests.rigs import Lab


def begun(lab: Lab) -> Path:
    """The folder of a session that was parked after its first stroke."""
    lab.write_protocol("[11.0, 15.0]")
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    engine.park()
    with pytest.raises(Parked):
        wait_for_end(engine)
    [folder] = lab.sessions.iterdir()
    return folder


def asked(engine: Engine) -> tuple[int, str]:
    """Number and text of the first question of a run."""
    engine.start()
    prompt = until(engine, lambda now: now.prompt is not None).prompt
    assert prompt is not None
    return prompt.number, prompt.question


def refuse(engine: Engine, number: int | None) -> None:
    """Answer no, or leave the screen."""
    if number is None:
        engine.park()
    else:
        engine.answer(number, "x")
    with pytest.raises(CollectAborted, match="nothing moved"):
        wait_for_end(engine)


def test_who_resumes_on_a_screen_is_asked_before_anything_moves(lab: Lab) -> None:
    folder = begun(lab)
    before = lab.rig.world.tool(), (folder / JOURNAL_NAME).read_bytes()
    for leaves in (False, True):
        engine = lab.engine(watched=True)
        number, question = asked(engine)
        assert engine.snapshot().state is State.ASKING
        assert folder.name in question
        assert "parked on request" in question
        refuse(engine, None if leaves else number)
        assert (lab.rig.world.tool(), (folder / JOURNAL_NAME).read_bytes()) == before

    SessionStore(folder, lambda: 1).release()  # as a process that is killed
    engine = lab.engine(watched=True)
    number, question = asked(engine)
    assert "cut off" in question
    engine.answer(number, "g")
    wait_for_end(engine)
    assert engine.snapshot().strokes_done == 2


@pytest.mark.parametrize(
    ("view", "said"),
    [
        (replace(SMALL_VIEW, width_px=640, height_px=480), "640 x 480 px"),
        (replace(SMALL_VIEW, centre_mm=(SMALL_VIEW.centre_mm[0] + 3.0, SMALL_VIEW.centre_mm[1])), r"3\.\d mm"),
    ],
)
def test_a_session_does_not_go_on_with_another_camera_or_a_board_elsewhere(lab: Lab, view: View, said: str) -> None:
    begun(lab)
    lab.rig.reconfigure(replace(lab.rig.config, view=view))
    with pytest.raises(NeedsOperator, match=said):
        lab.run()
    assert not [press for press in lab.rig.world.presses if press.depth_mm > 1.0][1:]


def test_a_resume_that_fails_while_connecting_still_names_its_session(lab: Lab) -> None:
    folder = begun(lab)
    lab.edit_rig(f"port = {lab.rig.arcs.port}", "port = 1")
    engine = lab.engine(watched=True)
    engine.start()
    with pytest.raises(DeviceError):
        wait_for_end(engine)
    now = engine.snapshot()
    assert (now.state, now.session_id, now.folder) == (State.FAILED, folder.name, str(folder))
