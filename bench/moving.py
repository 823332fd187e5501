"""`python -m bench.moving`: a moving picture of a session, docs/screens/session.svg, from the pictures of its screens.

One SVG shows them in turn, by CSS only, so that it also moves inside a page's `<img>`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

SCREENS = ("start", "set-up-camera", "set-up-self-check", "ask", "run", "end")
"""In the order of a session; all of them have one size."""
SECONDS_EACH = 2.0
NAME = "session.svg"
FOLDER = Path(__file__).resolve().parent.parent / "docs" / "screens"

SVG = re.compile(r"<svg[^>]*viewBox=\"([^\"]+)\"[^>]*>(.*)</svg>\s*$", re.S)


def moving(pictures: Sequence[str], seconds_each: float) -> str:
    """The pictures, SVG of one size and with ids of their own, in a loop; the last one stays for twice as long.

    Where the reader has asked for less motion, it is the last picture alone.
    """
    parts = [SVG.search(picture) for picture in pictures]
    assert all(parts), "each has a viewBox"
    turns = len(pictures) + 1
    frames: list[str] = []
    for place, part in enumerate(parts):
        assert part is not None
        frames.append(f'<g class="frame" style="animation-delay:{place * seconds_each:g}s">{part[2]}</g>')
    box = next(part[1] for part in parts if part)
    lasts = (100.0 / turns, 200.0 / turns)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{box}"><style>'
        f"@keyframes turn{{0%{{visibility:visible}}{lasts[0]:.3f}%{{visibility:hidden}}}}"
        f"@keyframes last{{0%{{visibility:visible}}{lasts[1]:.3f}%{{visibility:hidden}}}}"
        f".frame{{visibility:hidden;animation:turn {turns * seconds_each:g}s step-end infinite}}"
        ".frame:last-child{animation-name:last}"
        "@media (prefers-reduced-motion:reduce){.frame{animation:none}.frame:last-child{visibility:visible}}"
        f"</style>{''.join(frames)}</svg>\n"
    )


def session_picture(folder: Path) -> str:
    """The moving picture from the pictures in this folder."""
    return moving([(folder / f"{name}.svg").read_text(encoding="utf-8") for name in SCREENS], SECONDS_EACH)


def write_moving(folder: Path) -> None:
    """Write `session.svg` beside the pictures that it is made of."""
    (folder / NAME).write_text(session_picture(folder), encoding="utf-8")


if __name__ == "__main__":
    write_moving(FOLDER)
