"""However a run ends, it says so if the brush may be down, and what to do; and says nothing of it if it is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

from collect.errors import describe
from tests.collect.until import until, wait_for_end
from tests.waiting import wait_until

if TYPE_CHECKING:
    from conftest import Lab

    from collect.engine.engine import Engine

DOWN = "The brush may be down"


def end_of(engine: Engine) -> str:
    """The last line of the run, as the command prints it and as the screen shows it."""
    with pytest.raises(Exception) as ended:  # noqa: PT011 (what it says is looked at)
        wait_for_end(engine)
    assert engine.snapshot().error == describe(ended.value)
    return describe(ended.value)


ENDS: dict[str, Callable[[Lab, Engine], object]] = {
    "a stop": lambda _, engine: engine.stop(),
    "a safety stop": lambda lab, _: lab.rig.arcs.cabinet.safety_stop(),
    "a fault of the controller": lambda lab, _: lab.rig.arcs.cabinet.stop(2.0, 2.0),
}


@pytest.mark.parametrize("end", ENDS)
def test_an_end_with_the_brush_in_the_paper_says_so_and_what_to_do(lab: Lab, end: str) -> None:
    lab.write_protocol("[11.0]", "[0.0]")
    text = (lab.folder / "protocol.toml").read_text()
    (lab.folder / "protocol.toml").write_text(text.replace("dwell_s = 0.0", "dwell_s = 10.0"))
    engine, paper_mm = lab.engine(), lab.rig.config.table.paper_z_mm
    engine.start()
    wait_until(lambda: lab.rig.world.tool().z_mm < paper_mm - 10.0, "the brush to be at depth")
    ENDS[end](lab, engine)
    said = end_of(engine)
    assert DOWN in said
    assert "mm below the height of the paper" in said
    assert lab.rig.world.tool().z_mm < paper_mm


def test_a_run_that_ends_parked_does_not_speak_of_the_brush(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    engine.park()
    assert DOWN not in end_of(engine)


def test_a_run_that_is_stopped_at_travel_height_does_not_speak_of_the_brush(lab: Lab) -> None:
    engine = lab.engine()
    engine.start()
    until(engine, lambda now: now.strokes_done == 1)
    engine.pause()
    until(engine, lambda now: now.state == "paused")
    engine.stop()
    assert DOWN not in end_of(engine)
