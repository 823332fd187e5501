"""The rows of every table, for terminal and page alike."""

from __future__ import annotations

from dataclasses import dataclass

from calibrate.field import Alignment, Tone
from calibrate.validate import contenders as who
from calibrate.validate.paper import TABLE_1, TABLE_2, Printed
from calibrate.validate.report import Report, Rival, Stat
from calibrate.validate.run import CEILING, REPEATED

CALIBRATED = (who.FITTED_HELD_OUT, who.FITTED, who.BEZIER_REFITTED)
MISSING = {
    "ccd-bsmg": "not in this run: give a trained one with --generator",
    REPEATED: "not in this run: “brushloop loop” presses recovered strokes again",
}


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One row as the paper lays it out: CSIM max, min, avg, then SSIM; None where one side has no such row."""

    label: str
    basis: str
    n: int
    ours: tuple[float, ...] | None
    paper: tuple[float, ...] | None
    ceiling: bool


@dataclass(frozen=True, slots=True)
class FullRow:
    """CSIM and SSIM of one model with everything that is told of them."""

    label: str
    csim: Stat
    ssim: Stat
    ceiling: bool


def table_1(report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    """The generated models and robot writing, calibrated ones beside, and the ceiling."""
    names = [*TABLE_1, *_present(report, (who.FITTED_HELD_OUT, who.GENERATOR_HELD_OUT)), CEILING]
    return [_row(report, name, TABLE_1.get(name), alignment, tone) for name in names]


def table_2(report: Report, alignment: Alignment, tone: Tone) -> list[PaperRow]:
    """The paper's models in its order, then whatever else was compared."""
    others = [rival.name for rival in report.rivals if rival.name not in (*TABLE_2, CEILING, REPEATED, *who.LAMBDAS)]
    names = [*TABLE_2, *others, CEILING]
    return [_row(report, name, TABLE_2.get(name), alignment, tone) for name in names]


def full(report: Report, alignment: Alignment, tone: Tone) -> list[FullRow]:
    """Every model."""
    rows: list[FullRow] = []
    for rival in report.rivals:
        csim, ssim = (report.stat(rival.name, alignment, tone, measure) for measure in ("csim", "ssim"))
        if csim is not None and ssim is not None:
            rows.append(FullRow(rival.label, csim, ssim, rival.name == CEILING))
    return rows


def pair(report: Report, name: str, alignment: Alignment) -> str:
    """`CSIM / SSIM` on average, binary; empty where there is none."""
    found = [report.stat(name, alignment, Tone.BINARY, measure) for measure in ("csim", "ssim")]
    return " / ".join(f"{stat.avg:.2f}" for stat in found if stat is not None)


def rival(report: Report, name: str) -> Rival | None:
    """What a name stands for."""
    return next((one for one in report.rivals if one.name == name), None)


def _present(report: Report, names: tuple[str, ...]) -> list[str]:
    return [name for name in names if rival(report, name) is not None]


def _row(report: Report, name: str, printed: Printed | None, alignment: Alignment, tone: Tone) -> PaperRow:
    csim, ssim = (report.stat(name, alignment, tone, measure) for measure in ("csim", "ssim"))
    known = rival(report, name)
    ours = None
    if csim is not None and ssim is not None:
        ours = (csim.max, csim.min, csim.avg, ssim.max, ssim.min, ssim.avg)
    label = known.label if known is not None else printed.label if printed is not None else name
    basis = known.basis if known is not None and ours is not None else MISSING.get(name, "not in this run")
    paper = (*printed.csim, *printed.ssim) if printed is not None else None
    return PaperRow(label, basis, csim.n if csim is not None else 0, ours, paper, name == CEILING)
