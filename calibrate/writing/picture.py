"""Figure 13: reference, simulated and captured characters side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from calibrate.compare.field import Alignment, Image, Tone
from calibrate.loop.picture import PAPER, overlay
from calibrate.writing.compare import Written
from calibrate.writing.images import Polarity
from calibrate.writing.scores import REFERENCE, Character

HEADLINE = (Alignment.MM, Tone.BINARY, Polarity.INK)


def draw(written: Written, path: Path) -> None:
    """A row a character: reference, simulated, best and worst writing, and how often each place was inked."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = written.characters
    made = Figure((13.0, 0.5 + 2.9 * len(rows)), dpi=100, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(made)
    untyped: Any = made
    untyped.suptitle(f"{written.header.session_id} ({written.header.source})", fontsize=10)
    for one, axes in zip(rows, made.subplots(len(rows), 5, squeeze=False), strict=True):
        best, worst = ranked(written, one)[0], ranked(written, one)[-1]
        reference = one.reference[Tone.GRAY]
        parts: tuple[tuple[str, Image], ...] = (
            (f"reference {code_points(one.name)}", reference),
            ("simulated", one.simulated[Tone.GRAY]),
            (f"captured, best of {len(one.captured)}", one.captured[best][Tone.GRAY]),
            ("captured, worst", one.captured[worst][Tone.GRAY]),
            ("blue: mean of all captured; orange: reference", one.mean_ink()),
        )
        for axis, (title, image) in zip(axes, parts, strict=True):
            axis.set_title(title, fontsize=8, pad=2)
            axis.set_xticks([])
            axis.set_yticks([])
            if title.startswith("blue"):
                axis.imshow(overlay(reference, image), interpolation="nearest")
            else:
                axis.imshow(1 - image, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    untyped.savefig(path, format="png", metadata={"Software": None})


def ranked(written: Written, one: Character) -> list[str]:
    """Stroke ids by CSIM against the reference (mm, binary, ink = 1), best first."""
    found = {
        s.stroke_id: s.csim
        for s in written.scores
        if s.character == one.name and s.pair == REFERENCE and (s.alignment, s.tone, s.polarity) == HEADLINE
    }
    return sorted(found, key=lambda stroke_id: -found[stroke_id])


def code_points(name: str) -> str:
    """A name that any font can show: most machines have none with characters for a picture."""
    return " ".join(f"U+{ord(c):04X}" if ord(c) > 0x2E7F else c for c in name)
