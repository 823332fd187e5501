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
from pathlib import Path

from textual import work

from brushloop.collect.tui.widgets import Line, condition_text
from brushloop.sessions.records import Condition

FEWEST_CONDITIONS = 4
"""Conditions that it takes to predict each of them from the others."""
FIT_EVERY, SHOWN = 5, 4
"""Strokes from one fit to the next; newest scores that are shown."""


class ModelByNow(Line):
    """The newest scores, that of a perfect model, and where a press would teach most; not shown before the first."""

    DEFAULT_CSS = "ModelByNow { display: none; height: auto; }"

    def __init__(self) -> None:
        super().__init__("model", classes="pane")
        self.border_title = "Model by now: CSIM on conditions that were left out of its fit"
        self._csims = list[float]()
        self._fit_at: float = FIT_EVERY
        """Strokes at which the model is fitted next; infinite while a fit runs."""

    def follow(self, folder: str, strokes: int) -> None:
        """Fit anew when there are `FIT_EVERY` more strokes."""
        if folder and strokes >= self._fit_at:
            self._fit_at = math.inf
            self._fit(folder, strokes)

    @work(exclusive=True)
    async def _fit(self, folder: str, strokes: int) -> None:
        if (model := await model_so_far(Path(folder))) is not None:
            self._csims.append(model[0])
            self.show(f"{' → '.join(f'{csim:.1f}' for csim in self._csims[-SHOWN:])} % {model[1]}")
            self.display = True
        self._fit_at = strokes + FIT_EVERY


async def model_so_far(folder: Path) -> tuple[float, str] | None:
    """What `fit_so_far` says, in a process of its own; None where it says nothing."""
    command = (sys.executable, "-m", "brushloop.collect.tui.so_far", str(folder))
    null, pipe = asyncio.subprocess.DEVNULL, asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(*command, stdin=null, stdout=pipe, stderr=null)
    try:
        answer, _ = await process.communicate()
    finally:
        with suppress(ProcessLookupError):  # it has ended
            process.kill()
        await process.wait()
    return json.loads(answer) if answer else None


def fit_so_far(folder: Path) -> tuple[float, str] | None:
    """Fit the presses of a session that count, by the images that `Review` shows; None for figures, and for too few.

    Returns the average CSIM in percent on conditions that were left out of the fit; in words, from how many presses,
    what a perfect model would score, and the condition that is predicted worst. Raises `SessionError`.
    """
    import numpy as np

    from brushloop.calibrate.compare import brush_of, field_grid
    from brushloop.calibrate.fit.fit import fit_presses
    from brushloop.calibrate.fit.heldout import FITTED, leave_condition_out
    from brushloop.calibrate.stats import CEILING
    from brushloop.collect.tui.review_screen import Review
    from brushloop.model.presses import Presses
    from brushloop.model.similarity import csim

    review = Review(folder)
    inks = [(c.press.condition, review.pictures(c).binary) for c in review.captures if c.counts]
    commands = [(condition.depth_mm, condition.tilt_deg) for condition, ink in inks if ink is not None]
    if json.loads(review.header.protocol)["kind"] == "write" or len(set(commands)) < FEWEST_CONDITIONS:
        return None
    brush, ink = brush_of(review.header), np.array([ink for _, ink in inks if ink is not None], np.float64)
    presses = Presses(brush.radius_mm, brush.length_mm, field_grid(), np.array(commands), ink)
    stats, predicted = leave_condition_out(presses, fit_presses(presses))
    scores = {stat.model: stat.csim.avg for stat in stats}
    alike = {
        at: csim(images[FITTED], seen.mean(axis=0)) for at, (seen, images) in predicted.items() if FITTED in images
    }
    perfect = f"; a perfect model: {scores[CEILING]:.1f} %" if CEILING in scores else ""
    worst = condition_text(Condition(*min(alike, key=lambda at: alike[at])))
    words = f"from {len(presses)} presses{perfect}\npressing this condition again teaches most: {worst}"
    return scores[FITTED], words


if __name__ == "__main__":
    os.nice(19)
    if (model := fit_so_far(Path(sys.argv[1]))) is not None:
        sys.stdout.write(json.dumps(model))
