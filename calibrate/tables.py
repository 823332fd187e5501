"""The paper's tables, ours beside theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibrate.field import Alignment, Tone
from calibrate.presses import Score

PAPER_TABLE_2: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "ccd-bsm": ((94.25, 88.33, 91.84), (90.13, 85.16, 87.71)),
    "ellipse": ((86.43, 81.62, 84.15), (76.81, 71.05, 73.46)),
    "circle": ((71.40, 64.36, 67.03), (63.85, 57.21, 60.23)),
    "line": ((85.99, 81.26, 83.50), (77.38, 67.22, 72.77)),
}
"""Model -> (CSIM, SSIM) as (max, min, avg) in percent: the CCD-BSMG paper's Table 2, on its own real strokes."""


@dataclass(frozen=True, slots=True)
class Row:
    """Max, min and average of one model's scores, in percent."""

    model: str
    n: int
    csim: tuple[float, float, float]
    ssim: tuple[float, float, float]
    paper_csim_avg: float | None
    paper_ssim_avg: float | None


def table(scores: list[Score], alignment: Alignment, tone: Tone) -> list[Row]:
    """One row a model, in the order in which they first appear."""
    chosen = [score for score in scores if score.alignment is alignment and score.tone is tone]
    rows: list[Row] = []
    for model in dict.fromkeys(score.model for score in chosen):
        mine = [score for score in chosen if score.model == model]
        paper = PAPER_TABLE_2.get(model)
        rows.append(
            Row(
                model,
                len(mine),
                _max_min_avg([score.csim for score in mine]),
                _max_min_avg([score.ssim for score in mine]),
                paper[0][2] if paper else None,
                paper[1][2] if paper else None,
            )
        )
    return rows


def _max_min_avg(values: list[float]) -> tuple[float, float, float]:
    percent = 100.0 * np.asarray(values)
    return float(percent.max()), float(percent.min()), float(percent.mean())
