"""Asks the terminal, before the app takes it, whether it draws pixels."""

from __future__ import annotations

import os
import re
import select
import sys
import termios
import time
import tty
from typing import Literal

from collect.tui.sixel import terminal_cell_px

PixelKind = Literal["sixel", "kitty", "none"]
ASK = b"\x1b[c"
"""Primary device attributes, which nearly every terminal answers: `ESC [ ? 62 ; 4 ; 22 c`."""
ANSWER = re.compile(rb"\x1b\[\?([0-9;]*)c")
SIXELS = b"4"
KITTY_TERMS = ("kitty", "ghostty")
PATIENCE_S = 0.3


def pixels_of_terminal() -> PixelKind:
    """The kind of pixels this terminal says that it draws; `none` where it is no terminal, or does not answer.

    Sixels need the size of a cell too, without which a picture would not fit its place.
    """
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        return "none"
    if any(name in os.environ.get("TERM", "") for name in KITTY_TERMS):
        return "kitty"
    if terminal_cell_px() is None:
        return "none"
    return kind_of(_ask(sys.stdin.fileno(), sys.stdout.fileno()))


def kind_of(answer: bytes) -> PixelKind:
    """What an answer to `ASK` says."""
    found = ANSWER.search(answer)
    return "sixel" if found is not None and SIXELS in found[1].split(b";") else "none"


def _ask(keys: int, screen: int) -> bytes:
    """Send `ASK` and return what comes until the answer is whole, or for `PATIENCE_S`."""
    answer = b""
    try:
        before = termios.tcgetattr(keys)
        try:
            tty.setcbreak(keys, termios.TCSANOW)
            os.write(screen, ASK)
            deadline = time.monotonic() + PATIENCE_S
            while ANSWER.search(answer) is None and (left_s := deadline - time.monotonic()) > 0:
                if not select.select([keys], [], [], left_s)[0]:
                    break
                part = os.read(keys, 256)
                if not part:
                    break
                answer += part
        finally:
            termios.tcsetattr(keys, termios.TCSANOW, before)
    except (OSError, termios.error):
        return b""
    return answer
