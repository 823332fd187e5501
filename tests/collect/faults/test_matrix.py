"""Ten faults in ten phases of a session: each patch has its outcome, and in every one the arm ends at rest.

A run is fast up to its phase. As that begins, the arm slows down, and the fault strikes a move that is under way. And
however a run ends, it says so if the brush may be down, and what to do; and says nothing of it if it is not.
"""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from brushloop.collect.engine.control import State
from brushloop.collect.engine.snapshot import Snapshot
from brushloop.collect.errors import describe
from brushloop.drivers.arcs.controller import SafetyMode
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import (
    ConnectionLost,
    DeviceError,
    DeviceTimeout,
    MotionFailed,
    ProtocolViolation,
    RobotNotSafe,
)
from brushloop.drivers.geometry import distance
from brushloop.drivers.sim.faults import ALWAYS, Fault, Phase
from brushloop.sessions.errors import SessionError
from brushloop.sessions.mcap_writer import McapWriter
from brushloop.sessions.recording import Recording
from brushloop.sessions.store import SessionStore
from tests.journal_lines import read_lines
from tests.rigs import BARE, Lab
from tests.runs import SteppedEngine, until, wait_for_end

FAST, SLOW = BARE.rate, 0.5
"""Seconds of the arm for each second of the driver."""
POLL = "getSafetyModeType"
STRUCK = {"on": POLL, "nth": 3}
"""In a move: the third time that the driver asks while it waits, some hundredths of a second after the start."""


@pytest.fixture
def lab(bare_lab: Lab) -> Lab:
    """A phase is struck while the arm is slow: a dwell need not outlast the time between two polls."""
    bare_lab.edit_rig("\nleast_dwell_s", "\n# least_dwell_s")
    bare_lab.write_protocol("[15.0]", dwell_s=1.0)
    return bare_lab


@dataclass(frozen=True)
class Moment:
    """When a phase begins: in a step, with the arm on its way as `phase` says."""

    step: str = ""
    phase: Phase | None = None
    deep: bool = False
    """Only the line that really goes into the paper."""
    cuts: str = ""
    """The kind of the step that a fault of the robot cuts, whose attempt is void: a void press has burnt its patch."""


STILL = {"connecting": "getRobotNames", "powering": "rob1.RobotManage.poweron"}
"""Phases in which nothing moves, with the request that begins each: the fault strikes that."""
PHASES: dict[str, Moment] = {
    **dict.fromkeys(STILL, Moment()),
    "retreat": Moment("retreat"),
    "zero touch": Moment("zero touch", Phase.DESCENDING, cuts="zero_touch"),
    "dip": Moment("dip", Phase.DIPPING, cuts="dip"),
    "travel": Moment("press", Phase.TRAVELLING, cuts="press"),
    "descent": Moment("press", Phase.DESCENDING, deep=True, cuts="press"),
    "at depth": Moment("press", Phase.DESCENDING, deep=True, cuts="press"),
    "lift": Moment("press", Phase.LIFTING, cuts="press"),
    "parking": Moment("capture", cuts="capture"),
}
STEPS = ["zero_touch", "board", "dip", "press", "capture"]


@dataclass(frozen=True)
class Outcome:
    """How a run ends."""

    error: type[DeviceError] | None
    device: str = "robot"


DONE = Outcome(None)
SILENT = Outcome(MotionFailed)
"""The message says that the arm may still be moving, and to use the emergency stop."""
TIMEOUT, VIOLATION = Outcome(DeviceTimeout), Outcome(ProtocolViolation)
LOST, UNSAFE = Outcome(ConnectionLost), Outcome(RobotNotSafe)
BLIND = Outcome(DeviceTimeout, "camera")


def but_for_a_press(outcome: Outcome) -> list[Outcome]:
    """The controller carries out a press that it was released for, and answers that are lost are asked for again."""
    return [outcome] * 6 + [DONE] * 3 + [outcome]


FAULTS: dict[str, tuple[dict[str, Any], list[Outcome]]] = {
    # connecting and powering, then the eight phases in which the arm moves or has just moved
    "mute": ({"kind": "mute", "count": ALWAYS}, [TIMEOUT] * 2 + [SILENT] * 8),
    "late": ({"kind": "late", "late_s": 2.5}, but_for_a_press(TIMEOUT)),
    "split": ({"kind": "split", "count": ALWAYS}, [DONE] * 10),
    "duplicate": ({"kind": "duplicate", "count": ALWAYS}, [DONE] * 10),
    "wrong id": ({"kind": "wrong-id"}, but_for_a_press(TIMEOUT)),
    "malformed": ({"kind": "malformed"}, but_for_a_press(VIOLATION)),
    "drop": ({"kind": "drop", "for_s": 0.3}, but_for_a_press(LOST)),
    "protective stop": ({"kind": "protective-stop"}, [UNSAFE] * 10),
    "emergency stop": ({"kind": "emergency-stop"}, [UNSAFE] * 10),
    "frozen camera": ({"device": "camera", "kind": "frozen", "count": ALWAYS}, [BLIND] * 10),
}
TABLE = {name: dict(zip(PHASES, outcomes, strict=True)) for name, (_, outcomes) in FAULTS.items()}
PRESSING = ("descent", "at depth", "lift")


def carried_out(name: str, phase: str) -> bool:
    """Whether the controller makes the whole press, lift included, although the fault strikes it."""
    return phase in PRESSING and TABLE[name][phase] in (DONE, SILENT)


def patches() -> list[Any]:
    """One phase of each fault by default, each phase once; the other ninety in the soak."""
    chosen: list[Any] = []
    for row, fault in enumerate(FAULTS):
        for column, phase in enumerate(PHASES):
            default = (column - 3 * row) % 10 == 4
            chosen.append(pytest.param(fault, phase, marks=() if default else pytest.mark.soak, id=f"{fault}, {phase}"))
    return chosen


def fault_at(name: str, phase: str) -> Fault:
    fields: dict[str, Any] = {"device": "robot"} | FAULTS[name][0]
    if phase not in STILL and fields["device"] == "robot":
        # What strikes once strikes a request of the driver's own wait, all else whoever asks.
        once = fields.keys().isdisjoint({"count", "for_s"})
        if phase == "at depth":
            fields |= {"phase": Phase.PRESSED} | ({"on": POLL} if once else {})
        elif once:
            fields |= STRUCK
        else:
            fields |= {"nth": 10}
    return Fault.model_validate(fields)


def start_with_fault(lab: Lab, engine: SteppedEngine, name: str, phase: str) -> Pose | None:
    """Start the run and hang the fault as the phase begins, with a slow arm where a move is to be struck.

    Return where that move was to end.
    """
    moment, fault, rig = PHASES[phase], fault_at(name, phase), lab.rig
    if phase in STILL:
        methods, request = rig.arcs._methods, STILL[phase]
        carry_out = methods[request]

        def struck(params: dict[str, Any]) -> Any:
            methods[request] = carry_out
            rig.faults.hang(fault)
            return carry_out(params)

        methods[request] = struck
        engine.start()
        return None
    engine.start()
    until(engine, lambda now: now.step.startswith(moment.step))
    slow = SLOW / 2 if TABLE[name]["connecting"] is TIMEOUT else SLOW  # or the arm is there when the time is out
    rig.clock.shift(slow)

    def begins(_now: Snapshot) -> bool:
        to = rig.world.target()
        deep_enough = to is not None and (not moment.deep or to.z_mm < rig.config.table.paper_z_mm - 1.0)
        return deep_enough and moment.phase in (None, rig.faults.phase())

    until(engine, begins)
    target = rig.world.target()
    rig.faults.hang(fault)
    if TABLE[name]["connecting"] is DONE or TABLE[name][phase] is BLIND or carried_out(name, phase):
        over_s = rig.time.now_s + (1.6 / slow if phase == "at depth" else 1.0 if phase in PRESSING else 0.3)
        until(engine, lambda _: rig.time.now_s > over_s)
        rig.clock.shift(FAST)
    return target


def end_of(engine: SteppedEngine) -> BaseException | None:
    """What ended the run, once it is over."""
    try:
        wait_for_end(engine)
    except Exception as error:
        return error
    return None


@pytest.mark.parametrize(("name", "phase"), patches())
def test_a_fault_in_a_phase_ends_as_the_table_says(lab: Lab, name: str, phase: str) -> None:
    expected = TABLE[name][phase]
    engine = lab.engine()
    target = start_with_fault(lab, engine, name, phase)
    ended = end_of(engine)

    assert lab.rig.faults.strikes, "the fault has struck"
    now = engine.snapshot()
    assert now.state is (State.DONE if expected is DONE else State.FAILED), now.error
    assert type(ended) is (expected.error or type(None)), repr(ended)
    assert not isinstance(ended, DeviceError) or ended.device == expected.device
    assert ("may still be moving. Use the emergency stop" in now.error) is (expected is SILENT), now.error
    assert now.rest_unknown or expected is not SILENT
    assert not now.rest_unknown or "may still be moving" in now.error
    assert not (now.rest_unknown and now.parked)
    if isinstance(ended, RobotNotSafe):
        assert ended.remedy in now.error
        assert lab.rig.arcs.cabinet.power.safety != SafetyMode.NORMAL, "nothing is ever cleared automatically"

    assert lab.at_rest
    if expected in (DONE, BLIND):
        assert lab.rig.faults.phase() is Phase.PARKED
    elif carried_out(name, phase):
        assert lab.rig.world.tool().z_mm > lab.rig.config.table.paper_z_mm + 7.0, "lifted"
    elif target is not None and phase != "at depth":
        assert sum(distance(lab.rig.world.tool(), target)) > 0.5, "stopped on its way"
    assert_it_stays_at_rest(lab)
    assert_the_session_is_whole(lab, name, phase)


def assert_it_stays_at_rest(lab: Lab) -> None:
    """Not when the fault is over, not when a person has ended the stop, not when requests come late."""
    before = lab.rig.world.tool()
    lab.rig.faults.clear()
    lab.rig.arcs.cabinet.release()
    lab.rig.clock.shift(FAST)
    for method in ("rob1.MotionControl.startMove", "RuntimeMachine.resume"):
        lab.rig.arcs._methods[method]({})
    lab.rig.time.pass_s(0.1)  # half a minute of the arm's time
    assert lab.rig.world.tool() == before
    assert lab.at_rest


def assert_the_session_is_whole(lab: Lab, name: str, phase: str) -> None:
    outcome = TABLE[name][phase]
    if phase == "connecting" and outcome in (TIMEOUT, VIOLATION, LOST):
        assert not lab.sessions.is_dir(), "an arm that was not reached begins no session"
        return
    state = lab.state
    done, cut = [step.kind for step in state.files.values()], [begin for begin, _ in state.cut]
    if outcome is DONE:
        assert (done, cut) == (STEPS, [])
        assert state.closed is not None
        return
    cuts, attempts = PHASES[phase].cuts, 1
    if outcome is BLIND:  # a frozen camera shows at the next photograph
        cuts, attempts = "board" if cuts in ("", "zero_touch") else "capture", 3
    assert done == (STEPS[: STEPS.index(cuts)] if cuts else [])
    assert [begin.kind for begin in cut] == ([cuts] * attempts if cuts else [])
    for begin in cut:
        assert bool(begin.patches) is (begin.kind == "press")
        assert {(begin.sheet, patch) for patch in begin.patches} <= state.used_patches, "burnt"
        assert (lab.session / f"{begin.file}.part").is_file(), "its evidence is kept"
    store = SessionStore(lab.session, lab.rig.time.now_ns)
    store.verify()
    store.release()


DOWN = "The brush may be down"
ENDS: dict[str, Callable[[Lab, SteppedEngine], object]] = {
    "a stop": lambda _, engine: engine.stop(),
    "a safety stop": lambda lab, _: lab.rig.arcs.cabinet.safety_stop(),
    "another client's stop": lambda lab, _: lab.rig.arcs.cabinet.stop(2.0, 2.0),
}


def said_at_the_end(engine: SteppedEngine) -> str:
    """The last line of the run, as the command prints it and as the screen shows it."""
    ended = end_of(engine)
    assert isinstance(ended, Exception)
    assert engine.snapshot().error == describe(ended)
    return describe(ended)


@pytest.mark.parametrize("end", ENDS)
def test_an_end_with_the_brush_in_the_paper_says_so_and_what_to_do(lab: Lab, end: str) -> None:
    lab.write_protocol("[15.0]", dwell_s=20.0)
    engine, paper_z_mm = lab.engine(), lab.rig.config.table.paper_z_mm
    engine.start()
    until(engine, lambda now: now.step.startswith("press"))
    lab.rig.clock.shift(2.0)
    until(engine, lambda _: lab.rig.world.tool().z_mm < paper_z_mm - 10.0)
    ENDS[end](lab, engine)
    said = said_at_the_end(engine)
    assert DOWN in said
    assert "mm below the height of the paper" in said
    assert lab.rig.world.tool().z_mm < paper_z_mm


@pytest.mark.parametrize("ends", ["park", "stop"])
def test_a_pause_lasts_until_it_is_ended_and_an_end_at_travel_height_does_not_speak_of_the_brush(
    lab: Lab, ends: str
) -> None:
    engine = lab.started()
    engine.control.pause()
    until(engine, lambda now: now.state is State.PAUSED)
    later_s = lab.rig.time.now_s + 10.0
    until(engine, lambda _: lab.rig.time.now_s > later_s)
    assert (engine.snapshot().state, lab.presses) == (State.PAUSED, [])
    getattr(engine, ends)()
    assert DOWN not in said_at_the_end(engine)
    assert engine.snapshot().parked


# The disk belongs to the process that records, so a full one is no fault of the rig


@pytest.mark.parametrize("room", [0, 3, pytest.param(60, marks=pytest.mark.soak)])
def test_a_disk_that_fills_up_ends_the_run_and_with_room_the_same_command_goes_on(
    bare_lab: Lab, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """`room`: messages that fit."""
    record, written = McapWriter.record, list[Any]()

    def onto_a_full_disk(table: McapWriter, outgoing: Any) -> None:
        written.append(outgoing)
        if len(written) > room:
            raise OSError(errno.ENOSPC, "No space left on device")
        record(table, outgoing)

    with monkeypatch.context() as full:
        full.setattr(McapWriter, "record", onto_a_full_disk)
        with pytest.raises(SessionError, match="No space left on device"):
            bare_lab.run()
    assert bare_lab.engines[-1].snapshot().state is State.FAILED
    assert bare_lab.at_rest
    assert bare_lab.rig.faults.phase() in (Phase.PARKED, Phase.RESTING)
    assert bare_lab.rig.world.tool().z_mm >= bare_lab.rig.config.table.paper_z_mm + 8.0
    folder = bare_lab.session
    events = [line["event"] for line in read_lines(folder / "journal.jsonl")]
    # Where the last message of a step does not fit, the journal has no word for its end either: begun, not done.
    assert events.count("begin") == events.count("done") + 1
    assert events.count("void") <= 1
    assert len(bare_lab.state.cut) + len(bare_lab.state.running) == 1
    assert len(list(folder.glob("*.part"))) == 1, "the evidence is kept"

    bare_lab.run()
    assert len(list(Recording(folder).captures())) == 1
