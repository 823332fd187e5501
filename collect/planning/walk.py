"""Runs a protocol's generator with answers made up as if all went well; nothing is connected and nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from collect.planning.moves import StepMoves, moves_of
from collect.protocols.config import ProtocolConfig
from collect.protocols.steps import MARKING, Protocol, Result, Step, StepKind, with_self_check
from collect.rig.config import RigConfig
from collect.rig.paper import Cell, Layout, PaperPlane, Sheet
from collect.touch.selfcheck import partners


@dataclass(frozen=True, slots=True)
class Walked:
    """One step of the walk."""

    step: Step
    sheet: int
    """From 1."""
    cell: Cell | None
    """That it marks or shows."""
    moves: StepMoves
    more_cells: list[Cell] = field(default_factory=list[Cell])
    """That it marks besides."""


def sheet_of(config: RigConfig, protocol: ProtocolConfig) -> Sheet:
    """The sheet as this protocol divides it."""
    return Sheet(config.paper, protocol.own_cell_mm)


def layout_of(config: RigConfig, protocol: ProtocolConfig) -> Layout:
    """For `steps` and `planned`: the sheet's columns and rows, and what the self-check takes of the first."""
    sheet = sheet_of(config, protocol)
    if not config.self_check.enabled or not sheet.capacity:
        return sheet.layout
    first = sheet.cell(0)
    return replace(sheet.layout, taken=frozenset({0} | {cell.index for cell in partners(sheet, first, set())}))


def steps_on(config: RigConfig, protocol: ProtocolConfig) -> Protocol:
    """The steps as they are run on this rig: balanced over its sheet, with the self-check where it is switched on."""
    found = protocol.steps(layout_of(config, protocol))
    return with_self_check(found) if config.self_check.enabled else found


def walk(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step in order, each mark on the next free cell, a fresh sheet whenever one is full.

    The sheet must have room for a cell.
    """
    plane, sheet = PaperPlane(config.paper.touch_z_mm), sheet_of(config, protocol)
    number = dips = 0
    used: set[int] = set()
    generator = steps_on(config, protocol)
    try:
        step = next(generator)
        while True:
            answer: Result = {}
            cell, shown = None, number
            more: tuple[Cell, ...] = ()
            if step.kind in MARKING:
                if len(used) == sheet.capacity:
                    number += 1
                    used.clear()
                cell, shown = sheet.free(used, number + 1), number
                more = partners(sheet, cell, used) if step.kind == StepKind.SELF_CHECK else ()
                used |= {one.index for one in (cell, *more)}
                answer = {"sheet": number, "cell": cell.index}
            elif step.kind == StepKind.CAPTURE:
                shown = int(step.params["sheet"] or 0)
                cell = sheet.cell(int(step.params["cell"] or 0))
            moves = moves_of(config, plane, step, cell, more, dips=dips)
            dips += moves.dips
            yield Walked(step, shown + 1, cell, moves, list(more))
            step = generator.send(answer)
    except StopIteration:
        return
