"""Write files atomically, and read files of unknown content and size."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from calibrate.errors import CalibrationError
from sessions.disk import unwritable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_BYTES = 1024 * 1024
"""Of a file that people or this software write: a table, an artefact."""
MAX_PHOTOGRAPH_BYTES = 256 * 1024 * 1024


def check_target(path: Path, ending: str, *inputs: Path | None) -> None:
    """Before any work: whether a file may be written there. Raises `CalibrationError`.

    Another suffix might be a recording's or a photograph's, and inputs are never overwritten.
    """
    if path.suffix.lower() != ending:
        raise CalibrationError(str(path), f"must end in {ending}")
    if path.is_dir():
        raise CalibrationError(str(path), "is a folder")
    check_folder(path.parent)
    if any(one is not None and one.exists() and path.exists() and path.samefile(one) for one in inputs):
        raise CalibrationError(str(path), "is what is read; it is not overwritten")


def check_folder(folder: Path) -> None:
    """Before any work: whether files can be written into a folder, or it can be made. Raises `CalibrationError`."""
    if (found := unwritable(folder)) is not None:
        raise CalibrationError(str(found[0]), found[1])


def write_whole(path: Path, text: str) -> None:
    """Write beside, then rename: a reader sees the old file or the new one. Raises OSError and removes the part.

    Line ends stay as they are, and who may read a file that was there already.
    """
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(text.encode("utf-8"))
        if path.exists():
            shutil.copymode(path, part)
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def read_bounded(path: Path, most_bytes: int = MAX_BYTES) -> bytes:
    """The bytes of a file of at most so many. Raises `CalibrationError` where it is larger or cannot be read.

    A file that grows while it is read, or a pipe without a size, is cut off at that length.
    """
    try:
        if not path.is_file() and path.exists():
            raise CalibrationError(str(path), "is no file")
        with path.open("rb") as file:
            data = file.read(most_bytes + 1)
    except OSError as error:
        raise CalibrationError(str(path), error.strerror or str(error)) from None
    if len(data) > most_bytes:
        raise CalibrationError(str(path), f"is larger than {most_bytes} bytes")
    return data


def read_gray(path: Path) -> NDArray[np.uint8]:
    """(h, w) gray of a photograph, PNG or JPEG. Raises `CalibrationError` for other files and larger ones."""
    from sessions.errors import SessionDamaged
    from sessions.recording.messages import decode_gray

    try:
        return decode_gray(read_bounded(path, MAX_PHOTOGRAPH_BYTES), str(path))
    except SessionDamaged as error:
        raise CalibrationError(str(path), error.what) from None
