"""A plan is walked without a rig: limits, sheets, dips, ink, time, warnings; `brushloop collect plan` shows it; and the
moves of a press and a figure are those that it has checked."""

from __future__ import annotations

import math
from collections.abc import AsyncIterator, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import cv2
import pytest

from brushloop.collect.engine.recorder import StepContext
from brushloop.collect.engine.run import Run
from brushloop.collect.errors import ConfigError, StepVoid
from brushloop.collect.motion import Path as MotionPath
from brushloop.collect.motion import Procedures, inking_moves, stroke_moves
from brushloop.collect.plan import draw_plan, make_plan, path_s
from brushloop.collect.protocols.config import ProtocolConfig, load_protocol
from brushloop.collect.protocols.steps import MARKING, PressStep, Step, StepKind
from brushloop.collect.rig.config import RigConfig, load_rig
from brushloop.collect.rig.devices import Rig, limits_of
from brushloop.collect.rig.paper import PaperPlane, Sheet
from brushloop.collect.walk import (
    StepMoves,
    all_poses,
    ask_reach,
    check_poses,
    check_protocol,
    moves_of,
    sheet_of,
    walk,
)
from brushloop.drivers.arcs.controller import RobotMode
from brushloop.drivers.devices import Pose, QueuedLine
from brushloop.drivers.errors import ProtocolViolation
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.sim.arcs_server import ArcsServer
from brushloop.drivers.sim.config import SimConfig
from brushloop.drivers.sim.rig import rig_toml
from brushloop.drivers.sim.world import World
from brushloop.sessions.events import PressResult, StepResult
from brushloop.sessions.records import Condition
from tests.collect.conftest import RIG
from tests.collect.sent import not_checked, not_sent, noting
from tests.command import refused, said
from tests.rigs import WASH, WIPE, Lab
from tests.runs import answered_alike

EXAMPLES = Path(__file__).parents[3] / "examples"


def rig(folder: Path, text: str = RIG) -> RigConfig:
    (folder / "rig.toml").write_text(text)
    return load_rig(folder / "rig.toml")


def protocol(folder: Path, text: str) -> ProtocolConfig:
    (folder / "protocol.toml").write_text(text)
    return load_protocol(folder / "protocol.toml")


def example(name: str) -> ProtocolConfig:
    return load_protocol(EXAMPLES / name)


@pytest.fixture
def config(rig_path: Path) -> RigConfig:
    return load_rig(rig_path)


@pytest.mark.parametrize(
    ("name", "strokes", "patches", "sheets", "dips"),
    [
        ("protocol.toml", 150, 42, 4, 150),
        ("protocol-write.toml", 2, 6, 1, 4),  # figures have patches of their own size, and dip between strokes
    ],
)
def test_a_plan_says_what_a_protocol_takes(
    config: RigConfig, name: str, strokes: int, patches: int, sheets: int, dips: int
) -> None:
    plan = make_plan(config, example(name))
    assert (len(plan.placed), plan.patches_per_sheet, plan.sheets, plan.dips) == (strokes, patches, sheets, dips)
    assert len({(p.sheet, p.patch) for p in plan.placed}) == strokes
    assert list(plan.sheet_changes) == [plan.placed[i].stroke_id for i in range(patches, strokes, patches)]
    assert sum(plan.seconds_by_kind.values()) == pytest.approx(plan.seconds)


def figure(*points: list[float], patch: str = "[60.0, 60.0]") -> str:
    return f'kind = "write"\ncell_mm = {patch}\n[[figures]]\nname = "a"\n[[figures.strokes]]\npoints = {list(points)}\n'


HERE, THERE = [9.0, 9.0, 9.0, 0.0, 0.0], [20.0, 9.0, 9.0, 0.0, 0.0]
NEAR_TOUCH, TOO_DEEP, TOO_TILTED = [1.0, 0.0, 9.0, 0.0, 0.0], [20.0, 9.0, 23.0, 0.0, 0.0], [20.0, 9.0, 9.0, 20.0, 0.0]
TOUCH = ("touch_point_mm = [2.0, 2.0]", "touch_point_mm = [4.0, 26.0]")
NARROW = ("y_mm = [-260.0, 260.0]", "y_mm = [-260.0, 100.0]")
MOTION = "\n[motion]"
BY_JOG = MOTION, '\n[touch]\nmethod = "jog"\npoints_mm = [[2.0, 2.0], [240.0, 9.0]]\n' + MOTION
DEEP_TOUCH = MOTION, '\n[touch]\nmethod = "force"\ntravel_mm = 20.0\npoints_mm = [[200.0, 9.0]]\n' + MOTION
DEEP_CHECK = MOTION, "\n[self_check]\nenabled = true\ndepth_mm = 10.0\n" + MOTION
SOFT = "max_depth_mm = 22.0", "max_depth_mm = 9.5"
FAR_POT = MOTION, "\n[ink.wash]\npot_mm = [360.0, 20.0]\ndip_z_mm = 125.0\nevery_dips = 2\n" + MOTION
NARROWER = "y_mm = [-260.0, 260.0]", "y_mm = [-260.0, 240.0]"
LISTED = 'kind = "list"\npresses = [{depth_mm = 9.0}]\n'
REPLAYED = 'kind = "list"\nof = "s"\npresses = [{stroke_id = "b", depth_mm = 23.0, tilt_deg = 1.0}]\n'


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        (LISTED.replace("9.0", "23.0"), [], r"001-H23-a0-r01: 23 mm is deeper"),
        (REPLAYED, [], r"b~1: 23"),
        (figure(HERE, TOO_DEEP), [], r"a-r01: 23 mm is deeper than the rig's brush.max_depth_mm = 22 mm"),
        (figure(HERE, THERE, patch="[300.0, 60.0]"), [], r"protocol.toml: cell_mm: .* does not fit"),
        (figure(HERE, TOO_TILTED), [], r"tilt = 20.000 deg is outside .*\(a-r01 on patch 0\)"),
        (figure(NEAR_TOUCH, THERE), [TOUCH], r"\[4.0, 26.0\] lies within 5 mm of ink at \[3.0, 26.0\]"),
        (LISTED, [BY_JOG, NARROW], r"y = 130.000 mm is outside .*\(zero_touch\)"),
        (LISTED, [DEEP_TOUCH], r"z = 96\.\d+ mm is outside .*\(zero_touch\)"),
        (LISTED, [DEEP_CHECK, SOFT], r"z = 110.030 mm is outside .*\(self_check on patch 0\)"),
        (LISTED, [FAR_POT, NARROWER], r"y = 250.000 mm is outside .*\(dip\)"),
        (figure(HERE, THERE), [FAR_POT, NARROWER], r"y = 250.000 mm is outside .*\(dip\)"),
    ],
)
def test_what_cannot_be_done_is_named_before_anything_is_connected(
    tmp_path: Path, text: str, changes: list[tuple[str, str]], message: str
) -> None:
    changed = RIG
    for old, new in changes:
        assert old in changed
        changed = changed.replace(old, new)
    config = rig(tmp_path, changed)
    with pytest.raises(ConfigError, match=message):
        check_protocol(tmp_path / "rig.toml", tmp_path / "protocol.toml", config, protocol(tmp_path, text))


def test_a_sheet_that_leans_is_checked_as_it_lies(tmp_path: Path, config: RigConfig) -> None:
    wanted = example("protocol.toml")
    check_poses(tmp_path / "rig.toml", config, all_poses(config, wanted, PaperPlane(120.0)))
    with pytest.raises(ConfigError, match=r"z = \d\d\.\d+ mm is outside .* on patch \d+\)"):
        check_poses(tmp_path / "rig.toml", config, all_poses(config, wanted, PaperPlane(120.0, -0.05)))


def test_a_drawn_stroke_goes_through_its_points_at_its_depths(config: RigConfig) -> None:
    wanted = example("protocol-write.toml")
    steps = [(w.step, w.patches) for w in walk(config, wanted) if isinstance(w.step, PressStep)]
    assert [step.press.stroke_id for step, _ in steps] == ["shi-r01", "shi-r02"]
    draw, patches = steps[0]
    assert draw.press.condition.depth_mm == 9.0, "the deepest of its points"
    plane = PaperPlane(config.paper.touch_z_mm)
    moves = moves_of(config, plane, draw, patches)
    ways = [part for part in moves.segments if isinstance(part, MotionPath)]
    drawn = draw.drawn
    assert drawn is not None
    assert [len(way.poses) for way in ways] == [len(stroke) - 1 for stroke in drawn.strokes]
    patch = sheet_of(config, wanted).patch(0)
    # paper x is base y, paper y is base -x
    x_mm, y_mm, depth_mm, *_ = drawn.strokes[0][1]
    assert ways[0].poses[0].position_mm == pytest.approx(
        (460.0 - patch.y_mm - y_mm, -110.0 + patch.x_mm + x_mm, config.paper.touch_z_mm - depth_mm)
    )
    assert moves.dips == 1
    [(high, _), (clear, _), *_] = StepMoves(stroke_moves(config, plane, patch, drawn.strokes[1], 15.0)).poses
    assert high.quaternion == pytest.approx(clear.quaternion), "the wrist turns where the brush is upright and high"


def test_a_path_has_one_ramp_and_the_ink_of_a_plan_is_what_a_pump_doses(tmp_path: Path) -> None:
    start, *poses = (brush_pose(x_mm, 0.0, 200.0) for x_mm in (300.0, 310.0, 320.0))
    assert path_s(start, MotionPath(poses, 20.0), 800.0, limits_of(rig(tmp_path))) == pytest.approx(1.025)
    wanted = protocol(tmp_path, 'kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 12\n')
    assert make_plan(rig(tmp_path, rig_toml(SimConfig(ink_device="pump"))), wanted).ink_ml == pytest.approx(2 * 0.3)
    assert make_plan(rig(tmp_path), wanted).ink_ml is None


def test_a_self_check_takes_a_patch_before_the_first_stroke(tmp_path: Path) -> None:
    config = rig(tmp_path, f"{RIG}\n[self_check]\nenabled = true\n")
    check_protocol(tmp_path / "rig.toml", EXAMPLES / "protocol.toml", config, example("protocol.toml"))
    plan = make_plan(config, example("protocol.toml"))
    first = [str(walked.step.kind) for walked in walk(config, example("protocol.toml"))][:4]
    assert first == ["zero_touch", "board", "self_check", "dip"]
    assert (len(plan.placed), plan.placed[0].patch, plan.placed[41].sheet, plan.dips) == (150, 1, 1, 153)
    used = {placed.patch for placed in plan.placed if placed.sheet == 0}
    assert used == set(range(42)) - {0, 5, 36}, "the self-check lies over three corners"
    small = config.model_copy(update={"paper": config.paper.model_copy(update={"cell_mm": (20.0, 24.0)})})
    with pytest.raises(ConfigError, match=r"rig.toml: paper.cell_mm: a triangle of 24 by 15 mm does not fit"):
        check_protocol(tmp_path / "rig.toml", EXAMPLES / "protocol.toml", small, example("protocol.toml"))


# The command: tables, a picture, and the controller's word on reach


@pytest.fixture
async def cabinet(rig_path: Path) -> AsyncIterator[ArcsServer]:
    """One that listens where `rig.toml` says."""
    server = ArcsServer(World(SimConfig(rate=20.0)))
    await server.start("127.0.0.1", 0)
    rig_path.write_text(RIG.replace("port = 30004\n", f"port = {server.port}\n"))
    yield server
    await server.stop()


def test_a_plan_is_shown_as_tables_and_a_picture_that_cannot_be_made_is_refused_before_anything_else(
    rig_path: Path,
) -> None:
    command = ("collect", "plan", "--config", rig_path, "--protocol", EXAMPLES / "protocol.toml")
    words = said(*command)
    for expected in ("42 patches", "a fresh one before", "150 press", "not counting"):
        assert expected in words
    rig_path.write_text("[robot")  # is not even read
    why = refused(*command, "--picture", rig_path.with_name("plan.xyz"))
    assert why.endswith("plan.xyz: must end in .png or .svg or .pdf or .jpg")


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.toml")))
def test_every_example_passes_and_has_a_picture_whatever_its_names(rig_path: Path, tmp_path: Path, name: str) -> None:
    path, config = tmp_path / "plan.png", load_rig(rig_path)
    for each in EXAMPLES.glob("*.csv"):
        (tmp_path / each.name).write_bytes(each.read_bytes())
    # No font here has that character, and a dollar would begin a formula.
    (tmp_path / name).write_text((EXAMPLES / name).read_text().replace('"shi"', '"永$x"'))
    wanted = load_protocol(tmp_path / name)
    check_protocol(rig_path, tmp_path / name, config, wanted)
    plan = make_plan(config, wanted)
    assert plan.seconds > 10.0
    draw_plan(config, wanted, plan, path)
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert min(image.shape) > 400
    assert image.std() > 10.0


async def test_the_controller_is_asked_for_every_pose_and_nothing_is_powered_set_or_moved(
    rig_path: Path, cabinet: ArcsServer
) -> None:
    config, asked = load_rig(rig_path), list[str]()
    cabinet.cabinet.tcp_offset = [0.01, 0.0, 0.05, 0.0, 0.0, 0.4]  # another tool than ours is set there
    for name, method in list(cabinet._methods.items()):
        cabinet._methods[name] = lambda p, name=name, method=method: (asked.append(name), method(p))[1]
    wanted = example("protocol-write.toml")
    count = await ask_reach(rig_path, config, all_poses(config, wanted, PaperPlane(120.0)))
    assert count > 40
    names = {name.split(".")[-1] for name in asked}
    assert names == {"getRobotNames", "getTcpOffset", "getJointPositions", "inverseKinematics"}
    assert (cabinet.cabinet.power.mode, cabinet.cabinet.tcp_offset[0]) == (RobotMode.POWER_OFF, 0.01)


async def test_the_first_pose_out_of_reach_of_our_tool_is_named_whatever_is_set_on_the_controller(
    rig_path: Path, cabinet: ArcsServer
) -> None:
    """The same pose is as far away with either tool set; only a wrong conversion would bring it into reach."""
    config, messages = load_rig(rig_path), list[str]()
    row = [(brush_pose(x_mm, 0.0, 200.0), 10.0, f"{x_mm:.0f}") for x_mm in range(700, 1200, 20)]
    for offset in ([0.0] * 6, [0.0, 0.0, 0.18, 0.0, 0.0, 0.0], [0.05, -0.1, 0.3, 0.0, 0.0, 1.0]):
        cabinet.cabinet.tcp_offset = offset
        with pytest.raises(ConfigError, match=r"paper: .* no joint solution for (\d+): x = \1") as caught:
            await ask_reach(rig_path, config, row)
        messages.append(str(caught.value))
    assert messages == [messages[0]] * 3
    cabinet._methods["rob1.RobotConfig.getTcpOffset"] = lambda _: [math.nan] * 6
    with pytest.raises(ProtocolViolation, match="getTcpOffset: expected 6 finite numbers"):
        await ask_reach(rig_path, config, row)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "rig.toml: no such file: `brushloop rig new`"),
        (("--config", "p.toml"), "p.toml: is a protocol, not a rig: give it to --protocol"),
        (("--config", "r.toml", "--protocol", "r.toml"), "r.toml: is a rig, not a protocol: give it to --config"),
        (("--config", "r.toml"), "protocol.toml: no such file: choose another one"),
    ],
)
@pytest.mark.parametrize("command", ["strokes", "plan"])
def test_files_that_are_missing_or_swapped_are_named(
    rig_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, arguments: tuple[str, ...], words: str
) -> None:
    rig_path.rename(rig_path.with_name("r.toml"))
    rig_path.with_name("p.toml").write_text((EXAMPLES / "protocol.toml").read_text())
    monkeypatch.chdir(rig_path.parent)
    assert refused("collect", command, *arguments).startswith(words)


# A press is believed where the brush was seen at its depth


class MadeUpRobot:
    """Goes nowhere; it says that it has seen its targets, `off_mm` higher, and of those only the slice `seen`."""

    def __init__(self, off_mm: float = 0.0, seen: slice = slice(None)) -> None:
        self.off_mm, self.seen = off_mm, seen
        self.moved: list[Pose] = []
        self.queued: list[QueuedLine] = []

    async def follow(self, poses: Sequence[Pose], *, speed_mm_s: float, acc_mm_s2: float) -> None:
        self.moved += poses

    async def sequence(self, lines: Sequence[QueuedLine], *, acc_mm_s2: float) -> list[Pose]:
        self.queued += lines
        targets = [line.target for line in lines][self.seen]
        return [replace(pose, z_mm=pose.z_mm + self.off_mm) for pose in targets]


async def pressed(config: RigConfig, robot: MadeUpRobot, depth_mm: float = 13.0, dwell_s: float = 0.0) -> float:
    nothing = cast(Any, None)
    procedures = Procedures(Rig(config, nothing, cast(Any, robot), nothing))
    return await procedures.press(Sheet(config.paper).patch(7), Condition(depth_mm, 10.0), dwell_s)


@pytest.mark.parametrize(("depth_mm", "dwell_s", "lasts_s"), [(13.0, 0.0, 0.1), (0.04, 2.0, 2.0)])
async def test_the_way_into_the_paper_and_out_again_is_handed_over_as_one_and_is_long_enough_to_be_seen(
    config: RigConfig, depth_mm: float, dwell_s: float, lasts_s: float
):
    robot, touch_mm = MadeUpRobot(), config.paper.touch_z_mm
    assert await pressed(config, robot, depth_mm, dwell_s) == pytest.approx(depth_mm)
    assert all(pose.z_mm > touch_mm + 7.0 for pose in robot.moved)
    assert robot.queued[-1].target.z_mm > touch_mm + 50.0
    near, deep = (line for line in robot.queued if line.target.z_mm < touch_mm - 1e-6)
    assert deep.target.z_mm == pytest.approx(touch_mm - depth_mm, abs=0.01)
    assert 0.0 < near.target.z_mm - deep.target.z_mm <= 0.051
    assert [line.least_s for line in robot.queued if line.least_s] == [lasts_s]


@pytest.mark.parametrize(
    ("off_mm", "seen"),
    [(0.15, slice(None)), (-0.15, slice(None)), (0.0, slice(0, 1)), (0.0, slice(4, None)), (0.0, slice(0))],
)
async def test_a_press_that_was_not_seen_at_its_depth_is_void(config: RigConfig, off_mm: float, seen: slice):
    with pytest.raises(StepVoid, match=r"the depth was .* mm, 13 mm was commanded"):
        await pressed(config, MadeUpRobot(off_mm, seen))
    assert await pressed(config, MadeUpRobot(0.5 * off_mm)) == pytest.approx(13.0 - 0.5 * off_mm)


# Drawn strokes


def test_a_stroke_may_come_down_on_its_way(config: RigConfig) -> None:
    """Points above the paper: the brush is as far above it as asked when the way begins."""
    patch = sheet_of(config, example("protocol-write.toml")).patch(0)
    points = [(10.0, 10.0, -4.0, 3.0, 0.0), (20.0, 10.0, 5.0, 3.0, 0.0), (30.0, 10.0, -4.0, 3.0, 0.0)]
    *down, path, _, _ = (StepMoves([each]) for each in stroke_moves(config, PaperPlane(120.0), patch, points, 15.0))
    assert [move.poses[0][0].z_mm for move in down] == pytest.approx([180.0, 132.0, 132.0, 124.0])
    assert [pose.z_mm for pose, _ in path.poses] == pytest.approx([115.0, 124.0])


# Every target that reaches the arm's queue is one that the plan has checked, for every kind of step

FIGURE = "[[figures]]\nname = 'a'\n" + "".join(
    f"[[figures.strokes]]\npoints = [[12.0, {y}, {deep_mm}, 4.0, 30.0], [24.0, {y}, 1.0, 0.0, 60.0]]\n"
    for y, deep_mm in ((12.0, 8.0), (24.0, 1.0))
)
KINDS = {
    "grid": 'kind = "grid"\ndepths_mm = [9.0]\ntilts_deg = [5.0]\nrepeats = 2\nboard_every = 1\n',
    "write": f'kind = "write"\ncell_mm = [60.0, 60.0]\n{FIGURE}',
}
"""The other kinds press as a grid does."""


def rounded(poses: Iterable[tuple[Pose, ...]]) -> set[tuple[float, ...]]:
    return {tuple(round(v, 6) for v in (*pose.position_mm, *pose.quaternion)) for pose, *_ in poses}


@pytest.mark.parametrize("text", KINDS.values(), ids=KINDS)
def test_what_a_run_sends_the_plan_has_checked(lab: Lab, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    lab.edit_rig("", WIPE + WASH)
    wanted, config = protocol(lab.folder, text), load_rig(lab.folder / "rig.toml")
    check_protocol(lab.folder / "rig.toml", lab.folder / "protocol.toml", config, wanted)
    sent, left_out, do = list[Pose](), list[tuple[StepKind, list[Pose]]](), Run._do
    noting(lab.rig.world.motion, sent.append)

    async def checked(self: Run, step: Step, context: StepContext) -> StepResult:
        plane, dips = context.run.procedures.plane, context.run.procedures._dips
        planned = moves_of(config, plane, step, context.patches, dips=dips)
        assert rounded(planned.poses) <= rounded(all_poses(config, wanted, plane)), step
        # Where the ink had to wait, a press dips again.
        again = inking_moves(config, dips) if step.kind in MARKING else []
        sent.clear()
        result = await do(self, step, context)
        assert not not_checked(config, sent, [*planned.segments, *again]), step
        left_out.append((step.kind, not_sent(config, planned, sent)))
        return result

    monkeypatch.setattr(Run, "_do", checked)
    answered_alike(lab.engine(on_screen=True), "t")  # whoever jogs says at once that the tip touches
    assert not lab.state.cut
    assert {kind for kind, _ in left_out} >= {StepKind.ZERO_TOUCH, StepKind.BOARD}
    assert left_out.pop()[0] is StepKind.CAPTURE, "after the last one the arm does not set out for a dip"
    assert not [step for step in left_out if step[1]]
    if wanted.kind == "write":
        [drawn] = lab.state.results(PressResult)
        assert drawn.depths_mm == pytest.approx((8.0, 1.0), abs=0.1)
        # The peak force is that of the deepest stroke: the shallow one comes last, with 0.007 N.
        assert (drawn.peak_force_n or 0.0) > 0.02
