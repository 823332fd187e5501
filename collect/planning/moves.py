"""The moves of one step, as the procedures would make them."""

from __future__ import annotations

from dataclasses import dataclass, field

from collect.config import RigConfig
from collect.drawing import Drawn, stroke_moves
from collect.plane import PaperPlane
from collect.procedures import CLEARANCE_MM, Move, dip_moves, park_moves, press_moves, wash_moves, zero_touch_moves
from collect.sheet import Cell, to_base
from collect.steps import Step, StepKind
from collect.touch.selfcheck import triangle_on
from drivers.geometry import brush_pose
from drivers.samples import Pose


@dataclass(frozen=True, slots=True)
class Way:
    """Poses that are passed without a halt."""

    poses: list[Pose]
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class StepMoves:
    """What a step does, in order, and what it takes besides moving."""

    parts: list[Move | Way] = field(default_factory=list["Move | Way"])
    dwell_s: float = 0.0
    captures: int = 0
    dips: int = 0

    @property
    def poses(self) -> list[tuple[Pose, float]]:
        """Every pose that is commanded, with its speed."""
        found: list[tuple[Pose, float]] = []
        for part in self.parts:
            match part:
                case Move():
                    found.append((part.target, part.speed_mm_s))
                case Way():
                    found += [(pose, part.speed_mm_s) for pose in part.poses]
        return found


def moves_of(
    config: RigConfig, plane: PaperPlane, step: Step, cell: Cell | None, more: tuple[Cell, ...] = ()
) -> StepMoves:
    """`cell` is where a press or a figure goes; `more` are the others that a self-check marks."""
    match step.kind:
        case StepKind.ZERO_TOUCH:
            return StepMoves([*zero_touch_moves(config)])
        case StepKind.TOUCH:
            return StepMoves([*touch_moves(config, plane, _number(step, "x_mm"), _number(step, "y_mm"))])
        case StepKind.DIP:
            wash = config.ink.wash
            washed = [] if wash is None or step.index % wash.every_dips else wash_moves(config, wash)
            return StepMoves([*washed, *dip_moves(config)], dips=1)
        case StepKind.CHOOSE | StepKind.REVIEW:
            return StepMoves()
        case StepKind.BOARD | StepKind.CAPTURE:
            return StepMoves([*park_moves(config)], captures=1)
        case StepKind.PRESS:
            assert cell is not None
            down, up = press_moves(config, plane, cell, _number(step, "height_mm"), _number(step, "tilt_deg"))
            return StepMoves([*down, *up], dwell_s=_number(step, "dwell_s"))
        case StepKind.SELF_CHECK:
            assert cell is not None
            places_mm = triangle_on((cell, *more), config.self_check)
            moves = [
                move
                for x_mm, y_mm in places_mm
                for move in (*dip_moves(config), *touch_moves(config, plane, x_mm, y_mm))
            ]
            return StepMoves([*moves, *park_moves(config)], dips=3, captures=2)
        case StepKind.DRAW:
            assert cell is not None
            return _figure(config, plane, Drawn.of(step), cell)


def touch_moves(config: RigConfig, plane: PaperPlane, x_mm: float, y_mm: float) -> list[Move]:
    """Over a point of the sheet, down to clearance, slowly to where the surface is thought to be, and up."""
    motion, paper = config.motion, config.paper
    above = brush_pose(*to_base(paper, x_mm, y_mm), motion.safe_z_mm, heading_deg=paper.yaw_deg)
    return [
        Move(above, motion.travel_speed_mm_s),
        Move(plane.pose(paper, x_mm, y_mm, CLEARANCE_MM), motion.travel_speed_mm_s),
        Move(plane.pose(paper, x_mm, y_mm, 0.0), motion.press_speed_mm_s / 4),
        Move(above, motion.travel_speed_mm_s),
    ]


def _figure(config: RigConfig, plane: PaperPlane, drawn: Drawn, cell: Cell) -> StepMoves:
    parts: list[Move | Way] = []
    dips = 0
    for number, points in enumerate(drawn.strokes):
        if drawn.dips_before(number):
            parts += dip_moves(config)
            dips += 1
        moves = stroke_moves(config, plane, cell, points, drawn.speed_mm_s)
        parts += [*moves.down, Way(moves.way, moves.speed_mm_s), *moves.up]
    return StepMoves(parts, dips=dips)


def _number(step: Step, name: str) -> float:
    value = step.params[name]
    assert isinstance(value, float | int)
    return float(value)
