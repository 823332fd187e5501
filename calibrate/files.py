"""Write files atomically, and read files of unknown content and size."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.errors import CalibrationError
from brushloop.sessions.disk import check_writable, read_bounded, replacing

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_PHOTOGRAPH_BYTES = 256 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class Written:
    """The file that a command has written, and what the command prints."""

    path: Path
    said: Sequence[object]
    left_out: Sequence[tuple[str, str]] = ()
    """Strokes that could not be used, and why."""

    def lines(self) -> Sequence[object]:
        """What the command prints: lines and tables."""
        return self.said


def check_target(path: Path, *endings: str) -> None:
    """Check before any work that a file may be written to `path`. Raises `CalibrationError`.

    A file with another suffix might be a recording or a photograph.
    """
    if path.suffix.lower() not in endings:
        raise CalibrationError(str(path), f"must end in {' or '.join(endings)}")
    if path.is_dir():
        raise CalibrationError(str(path), "is a folder")
    check_writable(path.parent)


def write_whole(path: Path, text: str) -> None:
    """Write a file whole or not at all, with the line endings of `text` and the mode of an existing file.

    Raises OSError.
    """
    with replacing(path) as part:
        part.write_bytes(text.encode("utf-8"))
        if path.exists():
            shutil.copymode(path, part)


def read_gray(path: Path) -> NDArray[np.uint8]:
    """Read a PNG or JPEG photograph as (h, w) gray. Raises `InputError` for other files and larger ones."""
    from brushloop.sessions.errors import SessionDamaged
    from brushloop.sessions.messages import decode_gray

    try:
        return decode_gray(read_bounded(path, MAX_PHOTOGRAPH_BYTES), str(path))
    except SessionDamaged as error:
        raise CalibrationError(str(path), error.what) from None
