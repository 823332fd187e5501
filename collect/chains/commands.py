"""Other brushloop commands, each in a process of its own: what it imports and holds is gone when it ends."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

Say = Callable[[str], None]
GIVEN_UP = 3
"""Exit code of a collection that finished but left strokes out."""


class CommandFailed(Exception):
    """A command ended with an exit code; it has said why itself."""

    def __init__(self, words: list[str], code: int) -> None:
        self.words = words
        self.exit_code = code
        super().__init__(
            f"`brushloop {' '.join(words)}` ended with exit code {code}; the same command goes on from there"
        )


def run_command(say: Say, *arguments: str | Path, accepts: tuple[int, ...] = (0,)) -> int:
    """Run `brushloop ARGUMENTS` on this terminal to its end; returns its exit code. Raises `CommandFailed`."""
    words = [str(argument) for argument in arguments]
    say(f"$ brushloop {' '.join(words)}")
    process = subprocess.Popen([sys.executable, "-m", "brushloop", *words])
    while True:
        try:
            code = process.wait()
            break
        except KeyboardInterrupt:
            continue  # the command got it too, stops the arm and says so
    if code not in accepts:
        raise CommandFailed(words, code if code > 0 else 4)
    return code
