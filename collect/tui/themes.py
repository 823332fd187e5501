"""The colours of the screens: dark, light, and safe for colour-blind readers; and which of them was chosen."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from textual.theme import Theme

DARK, LIGHT, SAFE = "brushloop-dark", "brushloop-light", "brushloop-safe"
TITLES = {
    DARK: ("Dark colours", "For a dim room"),
    LIGHT: ("Light colours", "For a bright room"),
    SAFE: ("Colour-blind safe colours", "Blue, yellow and vermilion, which colour-blind readers can distinguish"),
}
THEMES = (
    Theme(
        name=DARK,
        primary="#6f9fc4",
        secondary="#a8a296",
        accent="#d9775c",
        foreground="#e9e5dc",
        background="#171613",
        surface="#1f1d1a",
        panel="#2b2824",
        boost="#26231f",
        success="#57a886",
        warning="#d8a54a",
        error="#c8473c",
        dark=True,
    ),
    Theme(
        name=LIGHT,
        primary="#1f5f99",
        secondary="#6b675f",
        accent="#b3402a",
        foreground="#1c1b19",
        background="#faf8f4",
        surface="#f3efe7",
        panel="#e6e0d4",
        boost="#efeae0",
        success="#1f7a5a",
        warning="#a86a00",
        error="#a8261c",
        dark=False,
    ),
    Theme(
        name=SAFE,
        # The colours of Okabe and Ito.
        primary="#56b4e9",
        secondary="#999999",
        accent="#cc79a7",
        foreground="#f2f2f2",
        background="#101214",
        surface="#181b1e",
        panel="#24292e",
        boost="#1e2226",
        success="#0072b2",
        warning="#f0e442",
        error="#d55e00",
        dark=True,
    ),
)
MAX_BYTES = 64


def chosen_file() -> Path:
    """Where the choice of colours is kept for the next start."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(state) / "brushloop" / "theme"


def chosen(file: Path | None) -> str:
    """The theme that was chosen last; dark where none was, or where the file holds anything else."""
    if file is None:
        return DARK
    try:
        with file.open("rb") as stream:
            name = stream.read(MAX_BYTES).decode("ascii", "replace").strip()
    except OSError:
        return DARK
    return name if name in TITLES else DARK


def keep(file: Path | None, name: str) -> None:
    """Keep a choice; where the folder cannot be written, it holds until the program ends."""
    if file is not None:
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(f"{name}\n", encoding="ascii")
