"""Which artefact of a session is in use. A pointer beside the artefacts says so; they themselves are never touched.

`calibration/current` holds the name of one of `calibration/*.json`, and so on for every kind. Sessions written before
there were pointers have none: there the artefact that was written last is in use.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

from calibrate.artefact import FOLDER, HASH_CHARS, Artefact
from calibrate.errors import CalibrationError
from calibrate.files import read_bounded, write_whole

POINTER = "current"
NAME = re.compile(rb"([0-9a-f]{%d}\.json)\n?" % HASH_CHARS)
"""Of an artefact: nothing else is followed, least of all a way out of the folder."""
MAX_POINTER_BYTES = 256

_log = logging.getLogger(__name__)


def put_to_use(artefact: Artefact, session: Path, folder: str = FOLDER) -> Path:
    """Save an artefact in that folder of a session and point there; returns where it lies. Raises OSError."""
    path = artefact.save(session / folder)
    write_whole(path.with_name(POINTER), path.name + "\n")
    return path


def artefacts(session: Path, folder: str = FOLDER) -> list[Path]:
    """Every artefact in that folder of a session, the one written first in front."""
    found = (path for path in (session / folder).glob("*.json") if path.is_file())
    return sorted(found, key=lambda path: (path.stat().st_mtime_ns, path.name))


def current(session: Path, folder: str = FOLDER) -> Path | None:
    """The artefact in use in that folder of a session; None where there is none.

    Raises `CalibrationError` for a pointer that leads nowhere. Where there are several and no pointer, a warning says
    which was taken.
    """
    pointer, found = session / folder / POINTER, artefacts(session, folder)
    if pointer.exists() or pointer.is_symlink():
        name = pointed(read_bounded(pointer, MAX_POINTER_BYTES), str(pointer))
        path = pointer.with_name(name)
        if path not in found:
            raise CalibrationError(str(pointer), f"names {name}, which is not there: {_choose(session, folder)}")
        return path
    if len(found) > 1:
        taken = f"{len(found)} artefacts, and no file `{POINTER}` says which is in use: {found[-1].name} is taken"
        _log.warning("%s: holds %s, as it was written last; %s", session / folder, taken, _choose(session, folder))
    return found[-1] if found else None


def pointed(data: bytes, where: str) -> str:
    """The file name that a pointer holds. Raises `CalibrationError`."""
    name = NAME.fullmatch(data)
    if name is None:
        raise CalibrationError(where, f"holds no name of an artefact ({HASH_CHARS} hexadecimal digits and .json)")
    return name[1].decode()


def _choose(session: Path, folder: str) -> str:
    if folder == FOLDER:
        return f"choose with `brushloop calibrate apply {session / folder}/<hash>.json {session}`"
    return f"choose with `--fit {session / folder}/<hash>.json`, or fit again"
