"""The loop as one picture: originals, what was recovered from them, and what the arm then pressed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibrate.compare.field import Alignment, Image, Tone
from calibrate.loop.compare import Closed
from calibrate.loop.pairs import Pair
from calibrate.loop.scores import AGAIN

KEY = (Alignment.MM, Tone.GRAY)
SHEET_ROWS = slice(32, 96)
"""The middle half: a press is at most half as thick as the field is high."""
MAX_ROWS = 12
PAPER = "#fbf9f4"


def shown(closed: Closed) -> list[Pair]:
    """At most `MAX_ROWS` pairs in the order of depth and tilt, evenly over all of them, the worst among them."""
    pairs = sorted(closed.paired.pairs, key=lambda p: (p.original.height_mm, p.original.tilt_deg, p.again.stroke_id))
    if len(pairs) <= MAX_ROWS:
        return pairs
    worst = min((s for s in closed.scores if (s.what, s.alignment, s.tone) == (AGAIN, *KEY)), key=lambda s: s.csim)
    chosen = {round(k) for k in np.linspace(0, len(pairs) - 1, MAX_ROWS - 1)}
    chosen |= {k for k, pair in enumerate(pairs) if pair.again.stroke_id == worst.again}
    return [pairs[k] for k in sorted(chosen)]


def draw(closed: Closed, path: Path) -> None:
    """A row a pair: original, recovered and simulated, re-pressed, and original under re-pressed. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    pairs = shown(closed)
    scores = {s.again: s for s in closed.scores if (s.what, s.alignment, s.tone) == (AGAIN, Alignment.MM, Tone.BINARY)}
    made = Figure((10.0, 0.6 + 1.35 * len(pairs)), dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(made)
    untyped: Any = made
    untyped.suptitle(f"{closed.original.header.session_id}, pressed again ({closed.again.header.source})", fontsize=10)
    rows = made.subplots(len(pairs), 4, squeeze=False)
    side = closed.field.side_mm
    extent = (0.0, side, 0.25 * side, 0.75 * side)
    for pair, axes in zip(pairs, rows, strict=True):
        original, again = pair.original, pair.again
        score = scores[again.stroke_id]
        titles = (
            f"{original.stroke_id}: H {original.height_mm:g} mm, alpha {original.tilt_deg:g} deg",
            f"recovered: H {again.height_mm:.2f} mm, alpha {again.tilt_deg:.1f} deg",
            f"re-pressed: CSIM {score.csim:.3f}, SSIM {score.ssim:.3f}",
            "gray both, orange original only, blue again only",
        )
        images = [part.images[KEY][SHEET_ROWS] for part in (original, again)]
        images.insert(1, pair.simulated[KEY][SHEET_ROWS])
        for axis, title in zip(axes, titles, strict=True):
            axis.set_title(title, fontsize=7, pad=2)
            axis.set_xticks([])
            axis.set_yticks([])
        for axis, image in zip(axes, images, strict=False):
            axis.imshow(1 - image, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
        axes[3].imshow(overlay(images[0], images[2]), extent=extent, interpolation="nearest")
    untyped.savefig(path, format="png", metadata={"Software": None})


def overlay(first: Image, second: Image) -> Image:
    """(h, w, 3) RGB of two (h, w) images of ink: what both have gray, the first alone orange, the second alone blue."""
    both = np.minimum(first, second)
    # Okabe and Ito's colours, as distances from white.
    lost = (
        both[..., None] * np.array([0.35, 0.35, 0.35])
        + (first - both)[..., None] * np.array([0.165, 0.631, 1.0])
        + (second - both)[..., None] * np.array([1.0, 0.553, 0.302])
    )
    return np.clip(1.0 - lost, 0.0, 1.0).astype(np.float32)
