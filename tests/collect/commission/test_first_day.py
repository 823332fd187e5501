"""The first day in unknown labs: killed and resumed, taught again, with a trap, and (as a soak) labs to their proof."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock

import pytest

from brushloop.collect.commission import camera, proof
from brushloop.collect.commission.places import AWAY
from brushloop.collect.commission.proof import ProofStep, read_proof
from brushloop.collect.commission.visit import Notebook
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.rig.config import load_rig
from brushloop.drivers.sim.lab_facts import Trap
from brushloop.sessions.events import ZeroTouchResult
from tests.collect.commission.conftest import LIMITS, InLab, errors, first_day, in_lab, newest_session

SMALL_PX = (800, 600)
FAST = 30.0
SOAK_RATE = 6.0
TRAPPED = dict(zip(range(20, 30), Trap, strict=True))
"""The last ten of thirty labs have a trap each."""
NAMED = {
    Trap.SWAPPED_CORNER: r"are swapped|as in a mirror",
    Trap.MIRRORED_CAMERA: r"mirrored.*Switch mirroring",
    Trap.WRONG_BOARD_SIZE: r"% of its printed size.*Print it again at 100 %",
    Trap.PARK_IN_PICTURE: r"in one of the two pictures.*Park the arm farther",
    Trap.SHEET_OUT_OF_REACH: r"move board and sheet",
    Trap.OLD_SOFTWARE: r"runs AUBOPE.*ask the maker for the upgrade",
    Trap.CABLE_PULLED: r"Check power, cable and address",
}
"""Traps that end a step: what is said. The others are said in passing, and the first day goes on."""
IN_PASSING = {
    Trap.TCP_IN_METRES: "This looks like metres",
    Trap.FORCE_SIGN: "The sensor counts a push toward the flange as positive",
    Trap.SLOW_CAMERA: "The camera is slow",
}


DELAY_MS = 170.0
PROVEN = (
    ZeroTouchResult(method="force", touch_z_mm=100.0),
    SimpleNamespace(offset_mm=(0.5, 0.2), turn_deg=0.1),
    [SimpleNamespace(retake=False, camera_delay_ms=DELAY_MS, camera_jitter_ms=20.0)],
)
"""What a run of the proof may have measured."""


class Killed(BaseException):
    """The process ends here, as by a power cut."""


@pytest.fixture(autouse=True)
def quick_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """No lab's camera but the slow one is later than this."""
    monkeypatch.setattr(camera, "LATE_MS", 800.0)


def hurried(person: InLab) -> InLab:
    """A person who leaves the lens out."""
    bring = person.bring

    async def without_lens(thing: str) -> bool:
        return not thing.startswith("hold-board") and await bring(thing)

    person.bring = without_lens
    return person


@pytest.fixture
def person() -> Iterator[InLab]:
    with in_lab(1, rate=FAST, picture_px=SMALL_PX) as found:
        yield hurried(found)


async def test_killed_again_and_again_it_asks_nothing_twice_and_a_step_taught_again_changes_only_what_rests_on_it(
    person: InLab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, save, kept, kills = tmp_path / "rig.toml", Notebook.save, 0, 0

    def save_and_be_killed(notebook: Notebook, path: Path) -> None:
        nonlocal kept
        save(notebook, path)
        kept += 1
        if kept % 4 == 0:
            raise Killed

    with monkeypatch.context() as killing:
        killing.setattr(Notebook, "save", save_and_be_killed)
        while True:
            try:
                assert await first_day(person, rig, armed=False) is None
                break
            except Killed:
                kills += 1
    assert kills > 10
    assert "this moves the arm. Start the same command again with --arm." in person.trouble
    kinds = [thing.split()[0] for thing in person.brought]
    once = [thing for thing, kind in zip(person.brought, kinds, strict=True) if kind not in AWAY]
    assert len(once) == len(set(once)), "something was brought twice, and it is not a picture that needs the arm there"
    assert kinds.index("clear-view") < kinds.index("park"), "the proof begins where the arm is left: within the limits"
    about = ("R:", "L:", "Squares of the print", "Side of a square", "Address of the cabinet")
    typed = [question for question in person.asked if question.startswith(about)]
    assert len(typed) == len(set(typed)) == 5

    text = rig.read_text(encoding="utf-8")
    assert "NOT PROVEN" in text
    assert "# the same pin touched from" in text
    off = errors(rig, person.lab)
    by_hand = LIMITS | {"touch_mm": 0.5}
    assert all(off[name] <= most for name, most in by_hand.items()), off

    before, brought = Notebook.load(rig), len(person.brought)
    await Wizard(person.visit(rig)).again("tip")
    after = Notebook.load(rig)
    assert {thing.split()[0] for thing in person.brought[brought:]} == {"pin", "upright"}
    changed = {field for field, taught in after.values.items() if taught.value != before.values[field].value}
    assert {"robot.tcp_offset_mm", "paper.origin_mm", "ink.dip_z_mm"} <= changed
    assert {field.split(".")[0] for field in changed} <= {"robot", "paper", "ink", "motion", "board", "aside", "touch"}
    assert {"camera.source", "brush.radius_mm", "touch.force.push_axis"}.isdisjoint(changed)
    assert rig.with_name("rig.toml.bak-1").read_text(encoding="utf-8") == text
    assert any("These values depend on this step and changed with it:" in text for _, text in person.shown)

    # The proof examines devices and keeps values as ever; its two runs, which take minutes, are left out.
    brought, asked = len(person.brought), len(person.asked)
    with monkeypatch.context() as proving:
        proving.setattr(ProofStep, "_run", AsyncMock())
        proving.setattr(proof, "read_proof", lambda _session: PROVEN)
        assert await first_day(person, rig) == rig
    assert len(person.brought) == brought, "something was brought again"
    assert all("The arm moves by itself" in question for question in person.asked[asked:])
    assert "NOT PROVEN" not in rig.read_text(encoding="utf-8")
    assert load_rig(rig).camera.latency_ms == DELAY_MS


async def test_a_trap_is_named_with_the_way_out_and_the_first_day_goes_on_once_it_is_mended(tmp_path: Path) -> None:
    with in_lab(2, Trap.MIRRORED_CAMERA, rate=FAST, picture_px=SMALL_PX) as person:
        hurried(person)
        person.mends = True
        person.leave_after = 3
        assert await first_day(person, tmp_path / "rig.toml", armed=False) is None
        assert _words_on(person, Trap.MIRRORED_CAMERA), person.trouble
        assert len(person.brought) == 3, "went on to the pin once it was mended"


def _words_on(person: InLab, trap: Trap) -> str:
    """What the wizard said that names the trap; empty if nothing does."""
    if trap in NAMED:
        found = re.search(NAMED[trap], person.trouble, re.DOTALL)
        return "" if found is None else found.group()
    return next((text for _, text in person.shown if IN_PASSING[trap] in text), "")


@pytest.mark.soak
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("seed", range(30))
async def test_thirty_labs(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Limits on time that the host's clock measures: the machine may be busy, and simulated time runs fast. Pictures are
    # drawn by the processor that also takes them, and six simulated seconds pass in one of the host's.
    monkeypatch.setattr(camera, "LATE_MS", 2500.0)
    for name, value in {
        "MOTION__LEAST_DWELL_S": 0.05 * SOAK_RATE,
        "FORCE__STALE_MS": 2000,
        "CAMERA__MAX_JITTER_MS": 2000,
        "CAMERA__MAX_DELAY_MS": 3000,
    }.items():
        monkeypatch.setenv(f"BRUSHLOOP_{name}", str(value))
    trap = TRAPPED.get(seed)
    with in_lab(seed, trap, rate=SOAK_RATE) as person:
        person.mends = trap is not None
        rig = tmp_path / "rig.toml"
        made = await first_day(person, rig)
        if trap is Trap.WRONG_BOARD_SIZE:  # the way out that is named: the camera's step depends on the board's size
            assert await Wizard(person.visit(rig, armed=True)).again("camera") is None
            made = await first_day(person, rig)
        assert trap is None or _words_on(person, trap), person.trouble
        assert made is not None, person.trouble
        off, (_, _, captures) = errors(made, person.lab), read_proof(newest_session(made))
        again = sum(capture.retake for capture in captures)
        assert all(off[name] <= most for name, most in LIMITS.items()), off
        assert len(captures) - again == proof.PRESSES
