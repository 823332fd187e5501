"""Steps of the first day: what a cabinet, a hand or a camera says is checked, and nothing moves unasked. After
going back, teaching a step again or leaving off, what was answered before is as it was."""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import AsyncMock, Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brushloop.collect.commission import arm, places, proof
from brushloop.collect.commission.arm import ASK_ADDRESS, ArmStep
from brushloop.collect.commission.brush import ASK_BUS, ASK_PORT, RADIUS, BrushStep, ForceStep, ask_depth, ask_length
from brushloop.collect.commission.camera import ASK_SQUARES
from brushloop.collect.commission.places import PlacesStep, check_pot, check_wipe
from brushloop.collect.commission.proof import ProofStep, slowly
from brushloop.collect.commission.sheet import BOARD, all_corners
from brushloop.collect.commission.tip import TipStep, measured_axis
from brushloop.collect.commission.visit import Notebook, Taught, Visit
from brushloop.collect.commission.wizard import Wizard
from brushloop.collect.errors import CollectAborted, ConfigError, NotAccepted
from brushloop.collect.operator import Prompt
from brushloop.collect.photograph.frames import Thumbnail
from brushloop.collect.rig.config import load_rig
from brushloop.drivers.devices import Pose
from brushloop.drivers.errors import DeviceTimeout
from brushloop.drivers.geometry import brush_pose
from brushloop.drivers.ink.station import InkStationConfig
from brushloop.drivers.sim.world import tool_of
from tests.collect.commission.conftest import BACK, Answering, Person, in_lab
from tests.collect.conftest import RIG


async def test_a_payload_of_0_kg_ends_the_step_unless_it_is_confirmed(tmp_path: Path) -> None:
    with in_lab(41) as person:
        person.lab.arcs.cabinet.payload[0] = 0.0
        with pytest.raises(NotAccepted, match="payload is 0 kg"):
            await ArmStep().carry_out(Answering(person.lab.host, "n").visit(tmp_path / "rig.toml"))


async def test_holds_that_were_not_upright_are_named_and_asked_for_again(tmp_path: Path) -> None:
    with in_lab(41, rate=30.0, picture_px=(800, 600)) as person:
        bring, hasty = person.bring, [6, 0, 0, 0]

        async def hastily(thing: str) -> bool:
            kind, index = thing.split()
            if kind != "upright" or hasty[-1:] != [int(index)]:
                return await bring(thing)
            if hasty.pop() == 6:  # the hand holds the brush as ever, but leaning
                aim = person.lab.aim(kind, int(index), "")
                lean = Rotation.from_rotvec([math.radians(9.0), 0.0, 0.0]) * Rotation.from_quat(aim.quaternion)
                qx, qy, qz, qw = (float(v) for v in lean.as_quat())
                await person._in_lab(person.lab.guide(Pose(*aim.position_mm, qx, qy, qz, qw)))
            return True  # otherwise still at the pin

        person.bring = hastily
        visit = person.visit(tmp_path / "rig.toml")
        await ArmStep().carry_out(visit)
        await TipStep().carry_out(visit)
    warned = [text[:6] for tone, text in person.shown if tone == "warning" and text.startswith("Pose ")]
    assert warned == ["Pose 1", "Pose 1", "Pose 1", "Pose 7"]
    assert len(visit.notebook.touched("upright")) == 12
    turn = TipStep().derived(visit.notebook)["robot.tcp_rotation_deg"]
    assert "12 times" in turn.how
    axis = Rotation.from_euler("ZYX", np.array(turn.value)[::-1], degrees=True).apply([0.0, 0.0, 1.0])
    true = tool_of(person.lab.facts.config)[:3, 2]
    assert math.degrees(math.acos(float(axis @ true))) < 0.2


@pytest.mark.parametrize(("count", "tilt_deg"), [(2, 0.0), (8, 10.0)])
def test_a_direction_that_too_few_or_scattered_holds_give_is_not_measured(count: int, tilt_deg: float) -> None:
    notebook = Notebook()
    for number in range(count):
        hold = brush_pose(320.0, 150.0, 90.0, heading_deg=90.0 * number, tilt_deg=tilt_deg * (number % 2))
        notebook = notebook.with_touch(f"upright {number}", hold)
    assert measured_axis(notebook) is None


def test_a_corner_that_the_arm_does_not_reach_is_named_with_where_the_board_has_to_lie() -> None:
    notebook = Notebook().with_values({"robot.tcp_offset_mm": Taught([0.0, 0.0, 180.0], "typed")})
    for corner in ("lower left", "lower right", "upper left"):
        notebook = notebook.with_touch(f"{BOARD} 0 {corner}", brush_pose(400.0, 0.0, 300.0))
    with pytest.raises(NotAccepted, match=r"^not touched: board upper right\. .* corners are 0\.25 to 0\.7 m from"):
        all_corners(notebook, BOARD)


@pytest.mark.parametrize(("armed", "said"), [(False, "with --arm"), (True, "left where it is")])
async def test_the_proof_runs_nothing_without_the_command_line_and_the_operators_key(
    armed: bool, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ProofStep, "_run", AsyncMock(side_effect=AssertionError("the arm would have moved")))
    monkeypatch.setattr(proof, "examine", AsyncMock(return_value=[]))
    monkeypatch.setattr(proof, "rig_of", lambda *_: SimpleNamespace(brush=SimpleNamespace(max_depth_mm=22.0)))
    person = Answering("")
    with pytest.raises(NotAccepted, match=said):
        await ProofStep().carry_out(person.visit(tmp_path / "rig.toml", armed=armed))
    assert len(person.asked) == armed


@pytest.mark.parametrize("dry", [True, False])
async def test_every_pose_of_the_proof_is_checked_before_the_arm_is_connected(
    dry: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    low = re.sub(r"(?m)^z_mm = \[.*", "z_mm = [98.0, 170.0]", RIG, count=1)  # travel height is 180
    (tmp_path / "rig.toml").write_text(low)
    monkeypatch.setattr(proof, "Engine", Mock(side_effect=AssertionError("the arm would have moved")))
    visit = Person().visit(tmp_path / "rig.toml", armed=True)
    protocol = 'kind = "grid"\ndepths_mm = [11.0]\ntilts_deg = [0.0]\nrepeats = 2\n'
    with pytest.raises(ConfigError, match=r"robot\.limits: a planned pose is outside the limits: z = "):
        await ProofStep()._run(visit, tmp_path, protocol, dry=dry)


def test_every_move_of_the_proof_is_slower_than_50_mm_s(rig_path: Path) -> None:
    rig = load_rig(rig_path)
    slow = slowly(rig)
    assert rig.motion.travel_speed_mm_s > 50.0, "otherwise faster"
    assert max(slow.motion.travel_speed_mm_s, slow.motion.press_speed_mm_s) < 50.0
    assert slow.robot.limits.speed_mm_s <= 50.0, "the driver refuses more"


Place = tuple[float, float, float]
WELL, RIM, SIDE = (300.0, 40.0, 121.0), (300.0, 56.0, 132.0), (316.0, 40.0, 133.0)
PARK_MM, AWAY_MM = (250.0, -230.0, 260.0), (420.0, -260.0, 260.0)
SHEET = {
    "robot.tcp_offset_mm": [0.0, 0.0, 0.0],
    "paper.origin_mm": [0.0, 0.0],
    "paper.yaw_deg": 0.0,
    "paper.size_mm": [240.0, 160.0],
    "paper.touch_z_mm": 120.0,
    "paper.touch_point_mm": [4.0, 4.0],
    "aside.plane": [120.0, 0.0, 0.0],
}


def touched(**places: Place) -> Notebook:
    """A well right of a level sheet of 240 x 160 mm at the origin of the base frame, and what was touched there."""
    notebook = Notebook().with_values({field: Taught(value, "typed") for field, value in SHEET.items()})
    for name, place in {"well_0": WELL, "well-rim_0": RIM, "park_0": (200.0, -300.0, 300.0), **places}.items():
        notebook = notebook.with_touch(name.replace("_", " "), brush_pose(*place))
    return notebook


def test_a_wipe_goes_from_the_well_over_the_touched_rim_a_little_below_it() -> None:
    notebook = touched(**{"well-rim_1": SIDE})
    check_wipe(notebook)
    values = PlacesStep().derived(notebook)
    assert values["ink.wipe.rim_mm"].value == pytest.approx([322.0, 40.0])
    assert values["ink.wipe.z_mm"].value == pytest.approx(131.5)
    assert not any(field.startswith("ink.wipe") for field in PlacesStep().derived(touched()))


def test_the_arm_travels_above_the_rim_of_the_pot_of_water_too() -> None:
    for rim_z_mm, safe_mm in ((150.0, 180.0), (210.0, 230.0)):  # 60 mm above the sheet, 20 mm above the highest rim
        pot = {"wash-rim_0": (120.0, 216.0, rim_z_mm), "wash-pot_0": (120.0, 200.0, 125.0)}
        check_pot(touched(**pot), "wash-rim 0", "wash-pot 0", "pot of water")
        values = PlacesStep().derived(touched(**pot))
        assert (values["ink.wash.dip_z_mm"].value, values["motion.safe_z_mm"].value) == pytest.approx((125.0, safe_mm))
    drowned = touched(**pot | {"wash-pot_0": (120.0, 200.0, 220.0)})
    with pytest.raises(NotAccepted, match="no deeper than the rim of the pot of water"):
        check_pot(drowned, "wash-rim 0", "wash-pot 0", "pot of water")


@pytest.mark.parametrize(
    ("rim", "said"),
    [
        ((236.0, 40.0, 133.0), "would end over the sheet"),
        ((420.0, 40.0, 133.0), "120 mm from the rim of the well"),
        ((316.0, 40.0, 121.0), "no deeper than the rim of the well"),
    ],
)
def test_a_wipe_that_cannot_be_one_is_refused_with_the_way_out(rim: Place, said: str) -> None:
    with pytest.raises(NotAccepted, match=f"{said}.*only this touch is repeated"):
        check_wipe(touched(**{"well-rim_1": rim}))


def picture(*, arm: bool, light: float = 1.0) -> Thumbnail:
    scene = np.full((120, 160), 200.0 * light, np.float32)
    if arm:
        scene[40:70, 60:90] = 60.0
    return scene


@pytest.fixture
def parked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Visit]:
    """Well and rim are touched; the arm is brought to a place, then parked, and a picture is taken with it at each."""

    def make(away_mm: Place, away: Thumbnail, parked: Thumbnail) -> Visit:
        visit, neither = Answering("enter", "enter").visit(tmp_path / "rig.toml"), Taught("n", "answered")
        visit.save(touched().without("park").with_values({"aside.wipe": neither, "aside.wash": neither}))
        flanges = [brush_pose(*away_mm), brush_pose(*PARK_MM)]
        monkeypatch.setattr(arm, "taught_flange", AsyncMock(side_effect=flanges))
        monkeypatch.setattr(places, "still", AsyncMock(side_effect=[away, parked]))
        for context in ("opened", "shown_live"):
            monkeypatch.setattr(places, context, lambda *_: contextlib.nullcontext())
        return visit

    return make


async def test_two_pictures_that_agree_show_the_arm_in_neither(parked: Callable[..., Visit]) -> None:
    """The light may change in between; and the first place is asked for again if only that one was touched before."""
    visit = parked(AWAY_MM, picture(arm=False), picture(arm=False, light=0.9))
    visit.save(visit.notebook.with_touch("clear-view 0", brush_pose(*PARK_MM)))
    await PlacesStep().carry_out(visit)
    touches = visit.notebook.touches
    assert (touches["park 0"].position_mm, touches["clear-view 0"].position_mm) == (PARK_MM, AWAY_MM)


@pytest.mark.parametrize(
    ("away_mm", "in_the_first", "said"),
    [
        (WELL, False, r"in one of the two pictures: 5 % .* you are asked for both places again"),
        ((*PARK_MM[:2], 300.0), True, r"only 40 mm apart.*150 mm or more apart"),
    ],
    ids=["an arm over the pot", "twice one place"],
)
async def test_pictures_that_say_nothing_are_taken_again_at_both_places(
    parked: Callable[..., Visit], away_mm: Place, in_the_first: bool, said: str
) -> None:
    visit = parked(away_mm, picture(arm=in_the_first), picture(arm=True))
    with pytest.raises(NotAccepted, match=said):
        await PlacesStep().carry_out(visit)
    assert "aside.parked" not in visit.notebook.values


# Going back, teaching a step again, leaving off

HOW, GIVE, LINE = "How do you want to go on?", "Pump 0.5 ml", "Serial line of the device"
R, L, DEEPEST, NAME = "R", "L", "Deepest press that this brush can take; 45% of L is cautious", "Name of the brush"
FILLED, INK, CAN = "What keeps the ink well filled?", "Name of the ink", "CAN bus of the force sensor"


async def led(person: Answering, folder: Path) -> Visit:
    """The tip is known; the person is led through brush and force."""
    visit = person.visit(folder / "rig.toml")
    visit.keep({"robot.tcp_offset_mm": Taught([0.0, 0.0, 180.0], "measured")})
    with pytest.raises(CollectAborted):
        await Wizard(visit, (BrushStep(), ForceStep())).run()
    return visit


@pytest.fixture
def station(monkeypatch: pytest.MonkeyPatch) -> AsyncMock:
    """The ink station that is connected to, whatever line is named."""
    station = AsyncMock()
    station.connect.return_value = SimpleNamespace(model="station", firmware="1")
    station.level.return_value = None
    monkeypatch.setattr(InkStationConfig, "device", lambda *_: station)
    return station


@pytest.mark.parametrize(
    ("answers", "asked"),
    [
        (("6", "48", BACK, "47", "20", "", BACK, "wolf"), [R, L, DEEPEST, L, DEEPEST, NAME, FILLED, NAME, FILLED]),
        (
            ("6", "48", "20", "", "n", "", *[BACK] * 6),
            [R, L, DEEPEST, NAME, FILLED, INK, CAN, INK, FILLED, NAME, DEEPEST, L, R],
        ),
        (
            ("6", "48", "20", "", "i", "/dev/ttyUSB0", "y", "y", "n", BACK),
            [R, L, DEEPEST, NAME, FILLED, LINE, GIVE, GIVE, GIVE, INK, GIVE],
        ),
    ],
    ids=["one question", "into the step before", "no dose again"],
)
async def test_back_asks_the_question_before_and_no_other(
    answers: tuple[str, ...], asked: list[str], tmp_path: Path, station: AsyncMock
) -> None:
    person = Answering(*answers)
    visit = await led(person, tmp_path)
    assert person.asked == asked
    assert station.dose.await_count == answers.count("y")
    if asked[-1] == R:
        assert not any(field.startswith("brush.") for field in visit.notebook.values)


@pytest.mark.parametrize(
    ("after", "asked"),
    [
        (("a", "n"), [GIVE, INK]),
        ((BACK, "/dev/ttyUSB1", "n"), [LINE, GIVE, INK]),
    ],
    ids=["again", "the question before"],
)
async def test_a_step_that_was_refused_goes_on_where_the_person_wants(
    after: tuple[str, ...], asked: list[str], tmp_path: Path, station: AsyncMock
) -> None:
    silent = DeviceTimeout("robot", "connect", "no reply in 1 s", condition="A stop was sent to the arm.")
    silent.add_note("The arm may still be moving.")
    station.connect.side_effect = [silent, station.connect.return_value]
    person = Answering("6", "48", "20", "", "i", "/dev/ttyUSB0", *after)
    await led(person, tmp_path)
    assert person.asked == [R, L, DEEPEST, NAME, FILLED, LINE, HOW, *asked]
    assert re.fullmatch(r"(?s)robot: connect: .* A stop was sent .* still be moving\.\nCheck power.*", person.trouble)


@pytest.mark.parametrize(
    ("asked", "line", "said"),
    [
        (ask_length([0.0, 0.0, 180.0]), "190", r"190 mm is not plausible \(5 to 180 mm\)"),
        (ask_depth(48.0), "30", r"30 mm is not plausible \(0\.5 to 28\.8 mm\)"),
        (RADIUS, "nan", "is not a number"),
        (RADIUS, "0,1", r"0\.1 is outside 0\.5 to 50 mm"),
        (ASK_PORT, "", "no serial line was named"),
        (ASK_BUS, "host:bus", "Port could not be cast to integer value as 'bus'"),
        (ASK_SQUARES, "26", "is not two numbers of squares like 26x20"),
        (ASK_ADDRESS, "192.0.2.7:65536", "Port out of range"),
        (ASK_ADDRESS, "the cabinet", "is not an address like 192.0.2.7"),
    ],
)
def test_a_line_that_cannot_be_the_value_is_refused_where_it_is_typed(asked: Prompt, line: str, said: str) -> None:
    assert asked.read is not None
    with pytest.raises(ValueError, match=said):
        asked.read(line)


async def test_a_step_is_taught_again_only_where_all_before_it_are_done_and_is_as_it_was_after_back(
    tmp_path: Path,
) -> None:
    person, steps = Answering(BACK), (BrushStep(), ForceStep())
    with pytest.raises(CollectAborted, match="`force` depends on brush, which is not taught yet"):
        await Wizard(person.visit(tmp_path / "rig.toml"), steps).again("force")
    await led(Answering("6", "48", "20", "", "n", ""), tmp_path)
    visit = person.visit(tmp_path / "rig.toml")
    before = visit.notebook
    await Wizard(visit, steps).again("brush")
    assert person.asked == [R]
    assert visit.notebook == before, "it was taught again by mistake"
