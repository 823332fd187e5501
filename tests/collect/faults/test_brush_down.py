"""However a run ends, it says so if the brush may be down, and what to do; and says nothing of it if it is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.errors import describe
from tests.rigs import until, wait_for_end
from tests.waiting import wait_until

if TYPE_CHECKING:
    from conftest import Stage

    from brushloop.collect.engine.engine import Engine

DOWN = "The brush may be down"
RELEASE = "rob1.MotionControl.startMove"
SLOW = 2.0


def end_of(engine: Engine) -> str:
    """The last line of the run, as the command prints it and as the screen shows it."""
    with pytest.raises(Exception) as ended:  # noqa: PT011 (what it says is looked at)
        wait_for_end(engine)
    assert engine.snapshot().error == describe(ended.value)
    return describe(ended.value)


ENDS: dict[str, Callable[[Stage, Engine], object]] = {
    "a stop": lambda _, engine: engine.stop(),
    "a safety stop": lambda stage, _: stage.rig.arcs.cabinet.safety_stop(),
    "another client's stop": lambda stage, _: stage.rig.arcs.cabinet.stop(2.0, 2.0),
}


@pytest.mark.parametrize("end", ENDS)
def test_an_end_with_the_brush_in_the_paper_says_so_and_what_to_do(stage: Stage, end: str) -> None:
    protocol, table = stage.folder / "protocol.toml", stage.rig.config.table
    protocol.write_text(protocol.read_text().replace("dwell_s = 1.0", "dwell_s = 20.0"))
    engine, methods = stage.engine(), stage.rig.arcs._methods
    release = methods[RELEASE]

    def slowly(params: dict[str, Any]) -> Any:
        if engine.snapshot().step.startswith("press"):
            stage.gears.shift(SLOW)  # or the press would be over before the run is ended
        return release(params)

    methods[RELEASE] = slowly
    engine.start()
    wait_until(lambda: stage.rig.world.tool().z_mm < table.paper_z_mm - 10.0, "the brush to be at depth")
    ENDS[end](stage, engine)
    said = end_of(engine)
    assert DOWN in said
    assert "mm below the height of the paper" in said
    assert stage.rig.world.tool().z_mm < table.paper_z_mm


@pytest.mark.parametrize("ends", ["park", "stop"])
def test_a_run_that_ends_at_travel_height_does_not_speak_of_the_brush(stage: Stage, ends: str) -> None:
    engine = stage.engine()
    engine.start()
    engine.pause()
    until(engine, lambda now: now.state is State.PAUSED)
    getattr(engine, ends)()
    assert DOWN not in end_of(engine)
