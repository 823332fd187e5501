"""Runs a protocol's generator with answers made up as if all went well; nothing is connected and nothing moves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from collect.config import RigConfig
from collect.plane import PaperPlane
from collect.planning.moves import StepMoves, moves_of
from collect.protocols.config import ProtocolConfig
from collect.protocols.planned import Layout
from collect.protocols.plans import cell_mm, steps
from collect.protocols.self_check import with_self_check
from collect.sheet import Cell, Sheet
from collect.steps import MARKING, Protocol, Result, Step, StepKind


@dataclass(frozen=True, slots=True)
class Walked:
    """One step of the walk."""

    step: Step
    sheet: int
    """From 1."""
    cell: Cell | None
    """That it marks or shows."""
    moves: StepMoves


def sheet_of(config: RigConfig, protocol: ProtocolConfig) -> Sheet:
    """The sheet as this protocol divides it."""
    return Sheet(config.paper, cell_mm(protocol))


def layout_of(config: RigConfig, protocol: ProtocolConfig) -> Layout:
    """For `steps` and `planned`: the sheet's columns and rows, and what the self-check takes of the first."""
    return replace(sheet_of(config, protocol).layout, taken=int(config.self_check.enabled))


def steps_on(config: RigConfig, protocol: ProtocolConfig) -> Protocol:
    """The steps as they are run on this rig: balanced over its sheet, with the self-check where it is switched on."""
    found = steps(protocol, layout_of(config, protocol))
    return with_self_check(found) if config.self_check.enabled else found


def walk(config: RigConfig, protocol: ProtocolConfig) -> Iterator[Walked]:
    """Every step in order, each mark on the next free cell, a fresh sheet whenever one is full.

    The sheet must have room for a cell.
    """
    plane, sheet = PaperPlane(config.paper.touch_z_mm), sheet_of(config, protocol)
    marks = 0
    generator = steps_on(config, protocol)
    try:
        step = next(generator)
        while True:
            number, index = divmod(marks, max(sheet.capacity, 1))
            answer: Result = {}
            cell = None
            if step.kind in MARKING:
                cell, answer = sheet.cell(index), {"sheet": number, "cell": index}
                marks += 1
            elif step.kind == StepKind.CAPTURE:
                number = int(step.params["sheet"] or 0)
                cell = sheet.cell(int(step.params["cell"] or 0))
            yield Walked(step, number + 1, cell, moves_of(config, plane, step, cell))
            step = generator.send(answer)
    except StopIteration:
        return
