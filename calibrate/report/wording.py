"""Sentences that terminal and report share, so that both say the same."""

from __future__ import annotations

import math
from collections.abc import Iterator

from calibrate.drags.measure import DragResults
from sessions.recording.schemas import Source


def source_note(source: Source) -> str:
    """What kind of ink this is, in one sentence."""
    match source:
        case Source.LOOPBACK:
            return "loopback rig: simulated brush, ink and camera; not a result on paper"
        case Source.REAL:
            return "real capture: ink on paper, pressed by the arm named below"
        case Source.IMPORT:
            return "imported photographs: not collected by brushloop; scale and commands as their table tells them"


def fit_sentences(results: DragResults) -> Iterator[str]:
    """The fits of an imported session, and what CCD-BSM has to do with them."""
    width, length = results.width_on_depth, results.length_on_commanded
    if width is None:
        yield "Width against depth: no fit (fewer than 3 whole strokes, or one depth only)."
    else:
        low, high = width.interval
        yield (
            f"Width at the middle against commanded depth: {width.slope:.3f} mm/mm (95 % {low:.3f} to {high:.3f}), "
            f"{width.intercept:+.2f} mm at depth 0, r = {width.r:.2f}, n = {width.n}."
        )
        if low <= 0.0:
            yield "The slope's interval reaches 0: these strokes do not tell how the brush opens with depth."
        else:
            ratio = width.slope / (2.0 * math.pi)
            yield (
                "CCD-BSM opens linearly with depth from zero, 2 λ R/L per mm. With λ = π this slope would be that of a "
                f"brush with R/L = {ratio:.4f} (the paper's brush: 6/48 = {6 / 48:.4f}); a width at depth 0 is an "
                "error of the zero touch, or ink that spreads, which CCD-BSM does not have."
            )
    if length is not None:
        yield (
            f"Measured length against commanded length: slope {length.slope:.3f}, {length.intercept:+.2f} mm, "
            f"r = {length.r:.2f}, n = {length.n}."
        )


DRAG_LIMITS = (
    "These are strokes that travel along the paper, by a brush whose radius and bundle length are not known. "
    "CCD-BSM describes one vertical press: its length, outline, CSIM and SSIM cannot be compared with a drag, and are "
    "not given. What can be compared is how width grows with depth."
)
