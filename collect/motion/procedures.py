"""What the arm does in each step. Every procedure begins and ends at safe height."""

from __future__ import annotations

import math
from dataclasses import dataclass

from collect.errors import StepVoid
from collect.photograph.photographer import Photographer, Ways
from collect.rig.config import RigConfig, WashConfig
from collect.rig.devices import Rig, limits_of
from collect.rig.paper import Cell, PaperPlane, to_base, to_paper
from drivers.geometry import brush_pose, interpolate, lean
from drivers.samples import Frame, Pose, QueuedLine

CLEARANCE_MM = 8.0
"""Height above the paper at which the fast approach ends."""
DEPTH_TOLERANCE_MM = 0.1
"""How far the depth at the end of the dwell may be from the one asked for."""
DWELL_MM = 0.05
"""Way of the dwell: the end of the descent, as slow as it has to last. ARCS cannot wait in its queue but by moving."""
TOUCH_TOLERANCE_MM = 0.1
"""How far the arm may rest from the taught height at zero touch."""


@dataclass(frozen=True, slots=True)
class Move:
    """A target and how fast to go there."""

    target: Pose
    speed_mm_s: float
    least_s: float = 0.0
    """How long it takes at least."""


class Procedures:
    """The moves of each step kind, from a rig's configuration; and their execution on its devices."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._config = rig.config
        self.plane = PaperPlane(rig.config.paper.touch_z_mm)
        """The taught height, level, until touches say better."""
        self._dips = 0
        over = over_sheet_move(rig.config)
        self.photographer = Photographer(
            rig.robot,
            rig.camera,
            rig.config.camera,
            rig.clock,
            Ways(
                over_mm=over.target.position_mm,
                park_mm=rig.config.motion.park_mm,
                over=lambda: self.go(over),
                park=self._park,
                over_sheet=self._over_sheet,
            ),
        )

    async def retreat(self) -> None:
        """Lift along the tool axis to safe height, then park. A killed process may have left the brush down."""
        here = await self._rig.robot.take_up()
        limits_of(self._config).check_start("robot", here)
        for move in retreat_moves(self._config, here):
            await self.go(move)

    async def zero_touch(self) -> float:
        """Visit the taught touch height at the touch point; returns the height at which the arm rests, in mm.

        This confirms that the arm reaches the height that the operator taught. It does not measure the paper.
        """
        *down, up = zero_touch_moves(self._config)
        for move in down:
            await self.go(move)
        rests_mm = (await self._rig.robot.where()).z_mm
        off_mm = rests_mm - self._config.paper.touch_z_mm
        if abs(off_mm) > TOUCH_TOLERANCE_MM:
            raise StepVoid(f"zero touch rests {off_mm:+.3f} mm from the taught height; limit {TOUCH_TOLERANCE_MM} mm")
        await self.go(up)
        return rests_mm

    async def dip(self) -> None:
        """Into the well and out again, wiped; washed before, where it is time for that."""
        for move in inking_moves(self._config, self._dips):
            await self.go(move)
        self._dips += 1

    async def press(self, cell: Cell, height_mm: float, tilt_deg: float, dwell_s: float) -> float:
        """Press once; returns the depth reached below the paper along its normal, in mm."""
        before, pressing = press_moves(self._config, self.plane, cell, height_mm, tilt_deg, dwell_s)
        for move in before:
            await self.go(move)
        # From here on the arm lifts by itself, whatever becomes of this program.
        lines = [QueuedLine(move.target, move.speed_mm_s, move.least_s) for move in pressing]
        seen = await self._rig.robot.sequence(lines, acc_mm_s2=self._config.motion.acc_mm_s2)
        depth_mm = max((-self.plane.above_mm(self._config.paper, pose) for pose in seen), default=0.0)
        if abs(depth_mm - height_mm) > DEPTH_TOLERANCE_MM:
            raise StepVoid(f"was seen {depth_mm:.3f} mm deep, {height_mm:g} mm were asked for")
        return depth_mm

    async def capture(self) -> Frame:
        """Park, then the first frame exposed after the camera has shown the arm gone."""
        return await self.photographer.photograph()

    async def _park(self) -> None:
        for move in park_moves(self._config):
            await self.go(move)

    async def _over_sheet(self) -> bool:
        here = await self._rig.robot.where()
        x_mm, y_mm = to_paper(self._config.paper, here.x_mm, here.y_mm)
        width_mm, height_mm = self._config.paper.size_mm
        return 0.0 <= x_mm <= width_mm and 0.0 <= y_mm <= height_mm

    async def go(self, move: Move) -> None:
        """One move, to its end."""
        motion = self._config.motion
        await self._rig.robot.move(move.target, speed_mm_s=move.speed_mm_s, acc_mm_s2=motion.acc_mm_s2)


def retreat_moves(config: RigConfig, here: Pose) -> list[Move]:
    """From anywhere: along the tool axis up to safe height if below it, upright, then to the park position."""
    motion = config.motion
    moves: list[Move] = []
    x_mm, y_mm, z_mm = here.position_mm
    if here.z_mm < motion.safe_z_mm:
        tilt_deg, heading_deg = lean(here)
        rise_mm = motion.safe_z_mm - here.z_mm
        out_mm = rise_mm * math.tan(math.radians(tilt_deg))
        x_mm += out_mm * math.cos(math.radians(heading_deg))
        y_mm += out_mm * math.sin(math.radians(heading_deg))
        qx, qy, qz, qw = here.quaternion
        z_mm = motion.safe_z_mm
        moves.append(Move(Pose(x_mm, y_mm, z_mm, qx, qy, qz, qw), motion.press_speed_mm_s))
    # Upright in place before travelling: a turn and a long line at once sweep the ferrule around.
    moves.append(Move(_upright(config, x_mm, y_mm, z_mm), motion.travel_speed_mm_s))
    return moves + park_moves(config)


def park_moves(config: RigConfig) -> list[Move]:
    """To the place where the arm waits, out of the camera's view."""
    return [Move(_upright(config, *config.motion.park_mm), config.motion.travel_speed_mm_s)]


def over_sheet_move(config: RigConfig) -> Move:
    """Over the middle of the sheet at travel height, where the camera must see the arm."""
    width_mm, height_mm = config.paper.size_mm
    x_mm, y_mm = to_base(config.paper, 0.5 * width_mm, 0.5 * height_mm)
    return Move(_upright(config, x_mm, y_mm, config.motion.safe_z_mm), config.motion.travel_speed_mm_s)


def photograph_moves(config: RigConfig) -> list[Move]:
    """Over the sheet, unless the arm is there, and out of the camera's view."""
    return [over_sheet_move(config), *park_moves(config)]


def zero_touch_moves(config: RigConfig) -> list[Move]:
    """Over the touch point, down to clearance, slowly to the taught height, and up."""
    motion, touch_mm = config.motion, config.paper.touch_z_mm
    x_mm, y_mm = to_base(config.paper, *config.paper.touch_point_mm)
    return [
        Move(_upright(config, x_mm, y_mm, motion.safe_z_mm), motion.travel_speed_mm_s),
        Move(_upright(config, x_mm, y_mm, touch_mm + CLEARANCE_MM), motion.travel_speed_mm_s),
        Move(_upright(config, x_mm, y_mm, touch_mm), motion.press_speed_mm_s / 4),
        Move(_upright(config, x_mm, y_mm, motion.safe_z_mm), motion.travel_speed_mm_s),
    ]


def inking_moves(config: RigConfig, dips: int) -> list[Move]:
    """A dip after so many others of the same process, and the wash before it where it is time for one."""
    wash = config.ink.wash
    washed = wash is not None and dips % wash.every_dips == wash.every_dips - 1
    return [*(wash_moves(config, wash) if wash is not None and washed else ()), *dip_moves(config)]


def dip_moves(config: RigConfig) -> list[Move]:
    """Over the well, down into the ink, up slowly; with a wipe, across the rim on the way up."""
    motion, wipe = config.motion, config.ink.wipe
    at = to_base(config.paper, *config.ink.well_mm)
    above = _upright(config, *at, motion.safe_z_mm)
    moves = [
        Move(above, motion.travel_speed_mm_s),
        Move(_upright(config, *at, config.ink.dip_z_mm), motion.press_speed_mm_s),
    ]
    if wipe is not None:
        rim = to_base(config.paper, *wipe.rim_mm)
        moves += [
            Move(_upright(config, *at, wipe.z_mm), motion.press_speed_mm_s),
            Move(_upright(config, *rim, wipe.z_mm), motion.press_speed_mm_s),
        ]
        above = _upright(config, *rim, motion.safe_z_mm)
    return [*moves, Move(above, motion.press_speed_mm_s)]


def wash_moves(config: RigConfig, wash: WashConfig) -> list[Move]:
    """Over the pot, down and up so many times, and up."""
    motion = config.motion
    at = to_base(config.paper, *wash.pot_mm)
    above = _upright(config, *at, motion.safe_z_mm)
    bottom = _upright(config, *at, wash.dip_z_mm)
    half = _upright(config, *at, 0.5 * (wash.dip_z_mm + motion.safe_z_mm))
    swirl = [Move(pose, motion.press_speed_mm_s) for _ in range(wash.strokes) for pose in (bottom, half)]
    return [Move(above, motion.travel_speed_mm_s), *swirl, Move(above, motion.travel_speed_mm_s)]


def press_moves(
    config: RigConfig, plane: PaperPlane, cell: Cell, height_mm: float, tilt_deg: float, dwell_s: float = 0.0
) -> tuple[list[Move], list[Move]]:
    """(over the cell and tilted about the tip at clearance; touch height, descend H, dwell and up again).

    The second list is one that the controller carries out by itself: it must end above the paper.
    Tilting about the tip just above the paper instead of on it leaves the same pose at touch and no smear.
    """
    motion, paper = config.motion, config.paper
    above = _upright(config, *to_base(paper, *cell.anchor_mm), motion.safe_z_mm)

    def pose(above_mm: float, tilt: float) -> Pose:
        return plane.pose(paper, *cell.anchor_mm, above_mm, tilt_deg=tilt)

    touch, deep = pose(0.0, tilt_deg), pose(-height_mm, tilt_deg)
    before = [
        Move(above, motion.travel_speed_mm_s),
        Move(pose(CLEARANCE_MM, 0.0), motion.travel_speed_mm_s),
        Move(pose(CLEARANCE_MM, tilt_deg), motion.press_speed_mm_s),
    ]
    pressing = [
        Move(touch, motion.press_speed_mm_s),
        Move(interpolate(touch, deep, max(0.5, 1.0 - DWELL_MM / height_mm)), motion.press_speed_mm_s),
        Move(deep, motion.press_speed_mm_s, max(dwell_s, motion.least_dwell_s)),
        Move(pose(CLEARANCE_MM, tilt_deg), motion.press_speed_mm_s),
        Move(above, motion.travel_speed_mm_s),
    ]
    return before, pressing


def _upright(config: RigConfig, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    return brush_pose(x_mm, y_mm, z_mm, heading_deg=config.paper.yaw_deg)
