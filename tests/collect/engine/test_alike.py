"""Every press is pressed alike: the paper is looked at before the dip, and the time from dip to touch is recorded."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from brushloop.collect.engine.progress import Progress
from brushloop.collect.engine.steps import brush as brush_steps
from brushloop.collect.planning.summary import make_plan
from brushloop.collect.planning.walk import as_planned
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.rig.config import load_rig
from brushloop.collect.tui.review_screen import Review
from brushloop.drivers.devices import Pose
from brushloop.sessions.mcap_file import McapFile
from brushloop.sessions.recording import Recording
from brushloop.sessions.records import Quality, Topic
from tests.collect.sent import noting
from tests.journal_lines import read_lines
from tests.runs import wait_for_end

if TYPE_CHECKING:
    from pathlib import Path

    from tests.rigs import Lab

LIST = 'kind = "list"\npresses = [{depth_mm = 11.0}, {depth_mm = 13.0}]\ndwell_s = 0.0\n'
FIGURE = (
    'kind = "write"\ncell_mm = [60.0, 60.0]\n[[figures]]\nname = "a"\n'
    "[[figures.strokes]]\npoints = [[15.0, 15.0, 5.0, 0.0, 0.0], [40.0, 15.0, 5.0, 0.0, 0.0]]\n"
    "[[figures.strokes]]\npoints = [[15.0, 30.0, 5.0, 0.0, 0.0], [40.0, 30.0, 5.0, 0.0, 0.0]]\n"
)


def run(lab: Lab, protocol: str = "") -> Path:
    """The session's folder."""
    if protocol:
        (lab.folder / "protocol.toml").write_text(protocol, encoding="utf-8")
    engine = lab.engine()
    engine.start()
    wait_for_end(engine)
    [folder] = lab.sessions.iterdir()
    return folder


def results(folder: Path, kind: str) -> list[dict[str, Any]]:
    done = [line for line in read_lines(folder / "journal.jsonl") if line["event"] == "done"]
    return [line["result"] for line in done if line["result"]["kind"] == kind]


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the screen said was being done, one after the other."""
    said: list[str] = []
    doing = Progress.doing

    def noted(self: Progress, what: str) -> None:
        said.extend([what] if said[-1:] != [what] else [])
        doing(self, what)

    monkeypatch.setattr(Progress, "doing", noted)
    return said


@pytest.fixture
def targets(request: pytest.FixtureRequest) -> list[str]:
    """Where the arm was sent, as far as it matters: "ink", "paper", "park"."""
    lab: Lab = request.getfixturevalue("sharp_lab" if "sharp_lab" in request.fixturenames else "lab")
    sent: list[str] = []
    config = load_rig(lab.folder / "rig.toml")

    def note(target: Pose) -> None:
        if target.position_mm == pytest.approx(config.motion.park_mm, abs=1e-3):
            sent.append("park")
        elif target.z_mm == pytest.approx(config.ink.dip_z_mm, abs=1e-3):
            sent.append("ink")
        elif target.z_mm < config.paper.touch_z_mm - 1.0 and sent[-1:] != ["paper"]:
            sent.append("paper")

    noting(lab.rig.world.motion, note)
    return sent


def test_nobody_looks_at_the_paper_between_dip_and_press(sharp_lab: Lab, targets: list[str], screen: list[str]) -> None:
    folder = run(sharp_lab)
    assert targets[targets.index("ink") :][:3] == ["ink", "paper", "park"]
    assert screen[screen.index("dip") :][:4] == ["dip", "check that the sheet is blank", "dip", "press H13-a0-r01"]
    presses = results(folder, "press")  # more than one where a photograph was late and the stroke was made again
    waits = [result["press"]["dip_to_touch_s"] for result in presses]
    assert min(waits) > 0.0
    recording = Recording(folder)
    [capture] = recording.captures()
    assert capture.stroke.dip_to_touch_s == waits[-1]
    assert [seen.press.dip_to_touch_s for seen in Review(folder).captures] == waits
    *_, (_, _, message) = McapFile(recording.path).sound().messages([str(Topic.QUALITY)])
    remark = Quality.model_validate_json(message.data).checks[-1]
    assert (remark.name, remark.score, remark.passed) == ("dip_to_touch", waits[-1], True)


def test_a_brush_that_waited_with_its_ink_dips_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, targets: list[str], screen: list[str]
) -> None:
    """A pause between dip and press is as good as any length: every wait counts as too long here."""
    monkeypatch.setattr(brush_steps, "STALE_INK_S", 0.0)
    lab.write_protocol("[11.0]", "[0.0]")
    run(lab)
    assert targets.count("ink") == 2
    assert screen[screen.index("press H11-a0-r01") :][:3] == ["press H11-a0-r01", "dip", "press H11-a0-r01"]


async def test_a_dip_of_zero_touch_or_the_self_check_is_none_for_a_press(monkeypatch: pytest.MonkeyPatch) -> None:
    run = SimpleNamespace(left_ink_ns=None)

    async def dipped(_context: Any) -> None:
        run.left_ink_ns = 1

    monkeypatch.setattr(brush_steps, "fill_brush", dipped)
    await brush_steps._fill_for_touch(cast(Any, SimpleNamespace(run=run)))
    assert run.left_ink_ns is None


@pytest.mark.parametrize(("protocol", "kind"), [(LIST, "press"), (FIGURE, "draw")])
def test_a_protocol_may_ask_for_a_wait(lab: Lab, screen: list[str], protocol: str, kind: str) -> None:
    head, _, rest = protocol.partition("\n")
    folder = run(lab, f"{head}\nwait_after_dip_s = 0.8\n{rest}")
    waits = [result["press"]["dip_to_touch_s"] for result in results(folder, kind)]
    assert len(waits) == 2 if kind == "press" else 1
    assert all(wait > 0.8 for wait in waits)
    assert screen.count("wait with the ink, 0.8 s from the dip") == 2


def test_a_wait_changes_no_key_and_a_protocol_without_one_reads_as_before(tmp_path: Path) -> None:
    path = tmp_path / "protocol.toml"
    path.write_text(LIST)
    without = load_protocol(path)
    path.write_text(LIST + "wait_after_dip_s = 5.0\n")
    asked = load_protocol(path)
    assert "wait_after_dip_s" not in without.model_dump_json()
    assert '"wait_after_dip_s":5.0' in asked.model_dump_json()
    assert keys(without) == keys(asked)


def keys(protocol: Any) -> list[str]:
    generator, found = protocol.steps(), list[str]()
    step = next(generator)
    try:
        while True:
            found.append(step.key)
            step = generator.send(as_planned(step, 0, 1))
    except StopIteration:
        return found


def test_a_plan_counts_the_wait(lab: Lab) -> None:
    config, path = load_rig(lab.folder / "rig.toml"), lab.folder / "protocol.toml"
    path.write_text(LIST)
    plain = make_plan(config, load_protocol(path)).seconds
    path.write_text(LIST + "wait_after_dip_s = 30.0\n")
    assert 2 * 25.0 < make_plan(config, load_protocol(path)).seconds - plain < 2 * 30.0


def test_a_stroke_that_waited_unlike_the_others_is_named_and_still_counts(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin, number = brush_steps.DipToTouch.begin, iter(range(9))

    async def late(self: brush_steps.DipToTouch, first: Any) -> None:
        await begin(self, first)
        assert self._left_ns is not None
        if next(number) == 2:
            self._left_ns -= 8_000_000_000  # as if eight seconds had passed

    monkeypatch.setattr(brush_steps.DipToTouch, "begin", late)
    lab.write_protocol("[11.0]", "[0.0]", repeats=4)
    engine = lab.engine()
    engine.start()
    wait_for_end(engine)
    [folder] = lab.sessions.iterdir()
    assert engine.snapshot().strokes_done == 4
    named = {seen.press.stroke_id: seen.unlike for seen in Review(folder).captures if seen.unlike}
    assert "after its dip, the others after" in named["H11-a0-r03"]
