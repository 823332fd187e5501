"""Rounds of learning: how near the ink came to the wanted image, and in which phases of the strokes it did not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brushloop.calibrate.compare.field import Image, Tone
from brushloop.calibrate.writing.compare import as_ink
from brushloop.calibrate.writing.plan_files import ways_of
from brushloop.calibrate.writing.plan_record import FigureRecord, Round
from brushloop.calibrate.writing.scores import HEADLINE, Character, compare_ink
from brushloop.model.characters.phases import Phase, phase_map


def round_of(figure: FigureRecord, one: Character, side_mm: float) -> Round:
    """What the writings of a figure show on average."""
    reference = as_ink(figure.wanted())
    scores = [compare_ink(reference, ink, HEADLINE)[0] for ink in one.captured.values()]
    lost = [lost_by_phase(figure, ink[Tone.BINARY], side_mm) for ink in one.captured.values()]
    mean = {phase: round(float(np.mean([share[phase] for share in lost])), 2) for phase in lost[0]}
    return Round(csim_percent=round(100.0 * float(np.mean(scores)), 3), lost_percent=mean)


def lost_by_phase(figure: FigureRecord, ink: Image, side_mm: float) -> dict[str, float]:
    """Wrong pixels (missing or too much) of (128, 128) ink by phase, in percent of the wanted ink."""
    if not figure.medians:
        return {}
    wanted = figure.wanted() > 0.5
    where = phase_map(ways_of(figure), side_mm, len(ink))
    wrong = np.bincount(where[wanted != (ink > 0.5)], minlength=len(Phase))
    share = 100.0 * wrong / max(1, np.count_nonzero(wanted))
    present = np.unique(where)
    return {str(phase): float(share[k]) for k, phase in enumerate(Phase) if k in present}


def phase_table(rounds: Sequence[Round]) -> list[tuple[str, list[float]]]:
    """(phase, its loss in every round) for the phases that the character has."""
    present = [str(phase) for phase in Phase if any(str(phase) in one.lost_percent for one in rounds)]
    return [(phase, [one.lost_percent.get(phase, 0.0) for one in rounds]) for phase in present]


def lost_in_words(rounds: Sequence[Round]) -> str:
    """The phases of the last round in which most is lost, most first."""
    lost = sorted(rounds[-1].lost_percent.items(), key=lambda item: -item[1]) if rounds else []
    return ", ".join(f"{phase} {share:.1f} %" for phase, share in lost[:3])
