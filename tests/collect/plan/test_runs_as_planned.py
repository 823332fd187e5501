"""Every target that reaches the arm's queue is one that the plan has checked, for every kind of protocol."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from brushloop.collect.engine.recorder import StepContext
from brushloop.collect.engine.run import Run
from brushloop.collect.motion import inking_moves
from brushloop.collect.protocols.config import load_protocol
from brushloop.collect.protocols.steps import MARKING, Step, StepKind
from brushloop.collect.rig.config import load_rig
from brushloop.collect.rig.paper import PaperPlane
from brushloop.collect.walk import all_poses, check_protocol, moves_of
from brushloop.drivers.devices import Pose
from brushloop.sessions.events import StepResult
from tests.collect.sent import not_checked, not_sent, noting
from tests.rigs import Lab
from tests.runs import answered_alike

EXTRAS = """
[ink.wipe]
rim_mm = [322.0, 20.0]
z_mm = 130.0

[ink.wash]
pot_mm = [305.0, 80.0]
dip_z_mm = 125.0
every_dips = 2
strokes = 1
"""
FIGURE = "[[figures]]\nname = 'a'\n" + "".join(
    f"[[figures.strokes]]\npoints = [[12.0, {y}, 6.0, 4.0, 30.0], [24.0, {y}, 8.0, 0.0, 60.0]]\n" for y in (12.0, 24.0)
)
KINDS = {
    "grid": 'kind = "grid"\ndepths_mm = [9.0]\ntilts_deg = [5.0]\nrepeats = 2\nboard_every = 1\n',
    "replay": 'kind = "replay"\nof = "s"\npresses = [{stroke_id = "b", depth_mm = 9.0, tilt_deg = 1.0}]\n',
    "few-strokes": 'kind = "few-strokes"\ndepths_mm = [9.0, 11.0]\ntilts_deg = [5.0]\nstrokes = 1\n',
    "write": f'kind = "write"\ncell_mm = [60.0, 60.0]\n{FIGURE}',
    "calibration": 'kind = "calibration"\ntouches_mm = [[20.0, 20.0], [200.0, 20.0]]\n',
}
LIKE_A_GRID = {"replay", "few-strokes"}
"""They press as a grid does, and are left to `make soak`."""


@dataclass
class Made:
    """A step that was done, and the targets that reached the arm's queue meanwhile."""

    step: Step
    context: StepContext
    plane: PaperPlane
    dips: int
    sent: list[Pose] = field(default_factory=list)


@pytest.fixture
def made(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> list[Made]:
    steps: list[Made] = []
    at_work: list[Made] = []
    do = Run._do

    async def noted(self: Run, step: Step, context: StepContext) -> StepResult:
        procedures = context.run.procedures
        at_work.append(Made(step, context, procedures.plane, procedures._dips))
        try:
            return await do(self, step, context)
        finally:
            steps.append(at_work.pop())

    def added(target: Pose) -> None:
        for one in at_work:
            one.sent.append(target)

    monkeypatch.setattr(Run, "_do", noted)
    noting(lab.rig.world.motion, added)
    return steps


def run(lab: Lab, protocol: str, extra: str = EXTRAS) -> None:
    """To its end; whoever jogs says at once that the tip touches."""
    lab.edit_rig("", extra)
    (lab.folder / "protocol.toml").write_text(protocol, encoding="utf-8")
    answered_alike(lab.engine(on_screen=True), "t")


def hold_against_the_plan(lab: Lab, made: list[Made]) -> None:
    rig_path, path = lab.folder / "rig.toml", lab.folder / "protocol.toml"
    config, protocol = load_rig(rig_path), load_protocol(path)
    check_protocol(rig_path, path, config, protocol)
    last = [one for one in made if one.step.kind is StepKind.CAPTURE][-1:]
    for one in made:
        patches = one.context.patches
        planned = moves_of(config, one.plane, one.step, patches, dips=one.dips)
        # Where the ink had to wait, a press dips again.
        again = inking_moves(config, one.dips) if one.step.kind in MARKING else []
        assert not not_checked(config, one.sent, [*planned.segments, *again]), one.step
        if one not in last:  # after the last capture the arm does not set out for a dip
            assert not not_sent(config, planned, one.sent), one.step
        checked = {rounded(pose) for pose, _, _ in all_poses(config, protocol, one.plane, every_patch=True)}
        assert {rounded(pose) for pose, _ in planned.poses} <= checked, one.step


def rounded(pose: Pose) -> tuple[float, ...]:
    return tuple(round(v, 6) for v in (*pose.position_mm, *pose.quaternion))


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.soak if kind in LIKE_A_GRID else ()) for kind in KINDS]
)
def test_what_a_run_sends_the_plan_has_checked(lab: Lab, made: list[Made], kind: str) -> None:
    run(lab, KINDS[kind])
    hold_against_the_plan(lab, made)
    assert {one.step.kind for one in made} >= {StepKind.ZERO_TOUCH, StepKind.BOARD}
