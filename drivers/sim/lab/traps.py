"""What goes wrong in a lab, one trap each: a mistake of the person, of whoever set a device up, or an accident.

`spring` puts a trap into a lab; `mended` gives the lab after the person was asked to correct the mistake and did so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from enum import StrEnum

import numpy as np

from brushloop.drivers.sim.lab.facts import CORNERS, Facts, over_sheet


class Trap(StrEnum):
    """Its name on the command line."""

    SWAPPED_CORNER = "swapped-corner"
    """The person takes two neighbouring corners for each other."""
    MIRRORED_CAMERA = "mirrored-camera"
    """The camera's driver mirrors its picture."""
    WRONG_BOARD_SIZE = "wrong-board-size"
    """The board was printed to fit the page: its squares are smaller than the line below it says."""
    TCP_IN_METRES = "tcp-in-metres"
    """Somebody typed the tool at the pendant in metres, where it takes millimetres; the person writes metres too."""
    PARK_IN_PICTURE = "park-in-picture"
    """The person parks the arm where the camera sees it."""
    SLOW_CAMERA = "slow-camera"
    """The camera's pictures arrive 1.2 s late."""
    FORCE_SIGN = "force-sign"
    """The sensor reports the push of the brush on the paper, not the paper's on the brush."""
    SHEET_OUT_OF_REACH = "sheet-out-of-reach"
    """The far corners of the sheet lie beyond the arm's reach."""
    OLD_SOFTWARE = "old-software"
    """The cabinet has the software before ARCS: only its port 8899 answers."""
    CABLE_PULLED = "cable-pulled"
    """Somebody trips over the controller's network cable in the middle of a step."""


SHRUNK = 0.97
"""What `fit to page` does to an A3 page."""
SLOW_S = 1.2
TOO_FAR_MM = 330.0
"""How much farther away the sheet lies."""


def spring(facts: Facts, trap: Trap) -> Facts:
    """The same lab with the trap in it."""
    rng = np.random.default_rng([facts.seed, 18])
    config, table, view = facts.config, facts.config.table, facts.config.view
    match trap:
        case Trap.SWAPPED_CORNER:
            first = int(rng.integers(4))
            return replace(facts, swapped=(CORNERS[first], CORNERS[(first + 1) % 4]))
        case Trap.MIRRORED_CAMERA:
            return replace(facts, config=replace(config, view=replace(view, mirrored=True)))
        case Trap.WRONG_BOARD_SIZE:
            table = replace(
                table, board_square_mm=SHRUNK * table.board_square_mm, board_marker_mm=SHRUNK * table.board_marker_mm
            )
            return replace(facts, config=replace(config, table=table))
        case Trap.TCP_IN_METRES:
            typed = (0.0, 0.0, config.tool_mm / 1e6, 0.0, 0.0, 0.0)
            return replace(facts, cabinet_tcp=typed, ruler_unit="m")
        case Trap.PARK_IN_PICTURE:
            return replace(facts, parks_in_picture=True)
        case Trap.SLOW_CAMERA:
            return replace(facts, config=replace(config, view=replace(view, delay_s=SLOW_S)))
        case Trap.FORCE_SIGN:
            return replace(facts, config=replace(config, sensor_sign=-1))
        case Trap.SHEET_OUT_OF_REACH:
            return _farther(facts)
        case Trap.OLD_SOFTWARE:
            return replace(facts, arcs_answers=False)
        case Trap.CABLE_PULLED:
            return replace(facts, cable_after=int(rng.integers(2, 7)))


def mended(trapped: Facts, clean: Facts, trap: Trap) -> Facts:
    """The lab once the person has corrected the mistake. A board that was printed too small is measured."""
    match trap:
        case Trap.WRONG_BOARD_SIZE:
            table = trapped.config.table
            return replace(trapped, printed_square_mm=table.board_square_mm, printed_marker_mm=table.board_marker_mm)
        case Trap.FORCE_SIGN:
            return replace(trapped, config=replace(trapped.config, sensor_sign=1))
        case _:
            return clean


def _farther(facts: Facts) -> Facts:
    """The sheet with its board, pots and camera moved away from the arm; the pin stays within reach."""
    table = facts.config.table
    x, y, _ = over_sheet(table)
    stretch = TOO_FAR_MM / math.hypot(x, y)
    origin = (table.origin_mm[0] + stretch * x, table.origin_mm[1] + stretch * y)
    return replace(facts, config=replace(facts.config, table=replace(table, origin_mm=origin)))
