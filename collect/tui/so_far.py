"""How good the model is by now: while the arm presses, another process fits the brush to the captures on disk.

It runs at the lowest priority, so that no stroke waits for it.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from textual import work

from brushloop.collect.tui.widgets import Line, condition_text
from brushloop.sessions.records import Condition

FEWEST_CONDITIONS = 4
"""Conditions that it takes to predict each of them from the others."""
FIT_EVERY, SHOWN = 5, 4
"""Strokes from one fit to the next; newest scores that are shown."""


@dataclass(frozen=True, slots=True)
class ModelSoFar:
    """How well the fitted brush predicts conditions that were left out of its fit: average CSIM in percent."""

    presses: int
    csim: float
    ceiling: float | None
    """That of a perfect model; None while no condition was pressed twice."""
    depth_mm: float
    tilt_deg: float
    """The condition that is predicted worst, whose presses teach most."""


class ModelByNow(Line):
    """The newest scores, that of a perfect model, and where a press would teach most; not shown before the first."""

    DEFAULT_CSS = "ModelByNow { display: none; height: auto; }"

    def __init__(self) -> None:
        super().__init__("model", classes="pane")
        self.border_title = "Model by now: CSIM on conditions that were left out of its fit"
        self._folder, self._csims = "", list[float]()
        self._fit_at: float = FIT_EVERY
        """Strokes at which the model is fitted next; infinite while a fit runs."""

    def follow(self, folder: str, strokes: int) -> None:
        """Fit anew when there are `FIT_EVERY` more strokes."""
        if folder != self._folder:
            self._folder, self._csims, self._fit_at, self.display = folder, [], FIT_EVERY, False
        if folder and strokes >= self._fit_at:
            self._fit_at = math.inf
            self._fit(folder, strokes)

    @work(exclusive=True)
    async def _fit(self, folder: str, strokes: int) -> None:
        if (model := await model_so_far(Path(folder))) is not None:
            self._csims.append(model.csim)
            scores = " → ".join(f"{csim:.1f}" for csim in self._csims[-SHOWN:])
            perfect = "" if model.ceiling is None else f"; a perfect model: {model.ceiling:.1f} %"
            worst = condition_text(Condition(model.depth_mm, model.tilt_deg))
            self.show(
                f"{scores} % from {model.presses} presses{perfect}\nleast known, so pressing it teaches most: {worst}"
            )
            self.display = True
        self._fit_at = strokes + FIT_EVERY


async def model_so_far(folder: Path) -> ModelSoFar | None:
    """Fit the presses of a session that count, in a process of its own; None for figures, and for too few presses."""
    command = (sys.executable, "-m", "brushloop.collect.tui.so_far", str(folder))
    null, pipe = asyncio.subprocess.DEVNULL, asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdin=null, stdout=pipe, stderr=null)
    try:
        answer, _ = await process.communicate()
    finally:
        with suppress(ProcessLookupError):  # it has ended
            process.kill()
        await process.wait()
    return ModelSoFar(**json.loads(answer)) if answer else None


def fit_so_far(folder: Path) -> ModelSoFar | None:
    """The same in this process, by the images that `Review` shows. Raises `SessionError`."""
    import numpy as np

    from brushloop.calibrate.compare import field_grid
    from brushloop.calibrate.fit.fit import fit_presses
    from brushloop.calibrate.fit.heldout import FITTED, Refit, held_out_scores, leave_out, refits
    from brushloop.calibrate.stats import CEILING
    from brushloop.calibrate.work import threads
    from brushloop.collect.tui.review_screen import Review
    from brushloop.model.presses import Presses, image_of
    from brushloop.model.similarity import csim

    review = Review(folder)
    radius_mm, length_mm = review.header.brush_radius_mm, review.header.brush_length_mm
    inks = [(c.press.condition, review.pictures(c).binary) for c in review.captures if c.counts]
    commands = [(condition.depth_mm, condition.tilt_deg) for condition, ink in inks if ink is not None]
    drawn = json.loads(review.header.protocol)["kind"] == "write"
    if drawn or len(set(commands)) < FEWEST_CONDITIONS or radius_mm is None or length_mm is None:
        return None
    ink = np.array([ink for _, ink in inks if ink is not None], np.float64)
    presses = Presses(radius_mm, length_mm, field_grid(), np.array(commands), ink)
    folds, start = leave_out(presses, presses.conditions), fit_presses(presses).values
    with threads(1) as scheduler:
        brushes = refits([Refit(others, start=start) for _, others in folds], None, scheduler)
    predicted = {
        condition: image_of(brush.outline(*condition), presses.grid)
        for (fold, _), brush in zip(folds, brushes, strict=True)
        for condition in fold
    }
    pairs = [(ink[numbers], {FITTED: predicted[at]}) for at, numbers in presses.conditions.items()]
    scores = {stat.model: stat.csim.avg for stat in held_out_scores(pairs, (FITTED,))}
    alike = {at: csim(predicted[at], ink[numbers].mean(axis=0)) for at, numbers in presses.conditions.items()}
    worst = min(alike, key=lambda at: alike[at])
    return ModelSoFar(len(presses), scores[FITTED], scores.get(CEILING), *worst)


if __name__ == "__main__":
    os.nice(19)
    if (model := fit_so_far(Path(sys.argv[1]))) is not None:
        sys.stdout.write(json.dumps(asdict(model)))
