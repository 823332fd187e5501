"""Immutable files named after the hash of their contents, and the pointer to the one that a session uses.

`calibration/current` holds the name of one of `calibration/*.json`; every kind of artefact has its own folder.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Generator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.sessions.disk import read_bounded

FOLDER, FITS = "calibration", "brushfit"
"""Folders of a session that hold its calibrations, and the fits of its brush."""
HASH_CHARS = 16
POINTER = "current"
NAME = re.compile(rb"([0-9a-f]{%d}\.json)\n?" % HASH_CHARS)
"""File name of an artefact. A pointer that holds anything else, such as a path out of the folder, is refused."""
MAX_POINTER_BYTES = 256
PLAIN = {"json_invalid": "is not JSON: give a file that brushloop wrote", "extra_forbidden": "unknown field"}
"""What is said where pydantic's own words are a riddle to whoever named the wrong file."""


def made_by() -> str:
    """The name and version of this software, as files record it."""
    return f"brushloop {version('brushloop')}"


@contextmanager
def checked_fields(where: str) -> Generator[None]:
    """Raise `CalibrationError` for the first invalid field of what is validated inside, in one line that names it."""
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        message = PLAIN.get(first["type"], first["msg"])
        raise CalibrationError(where, f"{field}: {message}" if field else message) from None


class Frozen(BaseModel):
    """Base class of what is read from files: frozen, without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)


class Artefact(Frozen):
    """Base class of artefacts, which are saved under the hash of their canonical JSON."""

    FOLDER: ClassVar[str] = FOLDER
    """The folder of a session in which artefacts of this kind are put to use."""

    @property
    def digest(self) -> str:
        """The first characters of the sha256 of the canonical JSON: the file's name."""
        return hashlib.sha256(self._canonical()).hexdigest()[:HASH_CHARS]

    def _canonical(self) -> bytes:
        return self.model_dump_json(indent=2).encode() + b"\n"

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an artefact of this kind.

        Raises `InputError` if there is none, and `CalibrationError` for any other file or version, or an edited one.
        """
        data = read_bounded(path)
        with checked_fields(str(path)):
            artefact = cls.model_validate_json(data)
        if hashlib.sha256(data).hexdigest()[:HASH_CHARS] != path.stem:
            raise CalibrationError(str(path), "was edited or renamed: its name is not the hash of its contents")
        return artefact

    def save(self, folder: Path) -> Path:
        """Write `<digest>.json` into `folder`; an existing one has the same contents and is kept. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.digest}.json"
        if not path.exists():
            write_whole(path, self._canonical().decode())
        return path


class SessionFit(Artefact):
    """Base class of what is fitted to the strokes of one session."""

    schema_version: Literal[1] = 1
    session_id: str
    source: str
    recording_sha256: str
    calibration: str
    """Digest of the calibration that the captures were rectified with; empty for an import."""
    software: str


class FittedValue(Frozen):
    """A fitted number; the interval is missing where the data do not determine the number."""

    value: float
    low: float | None
    high: float | None
    """Ends of the 95 % interval."""

    def __str__(self) -> str:
        """The number and its interval, as tables show it."""
        interval = "not determined" if self.low is None else f"{self.low:.2f} to {self.high:.2f}"
        return f"{self.value:.2f} ({interval})"


def put_to_use(artefact: Artefact, session: Path) -> Path:
    """Save an artefact in its folder of a session and point to it; returns its path. Raises OSError."""
    path = artefact.save(session / artefact.FOLDER)
    write_whole(path.with_name(POINTER), path.name + "\n")
    return path


def current(session: Path, folder: str = FOLDER) -> Path | None:
    """Path of the artefact in use in `folder` of a session; None if it has no artefact.

    Raises `CalibrationError` where no pointer says which of the artefacts it is, or names one that is not there.
    """
    pointer = session / folder / POINTER
    if not pointer.exists():
        if any(pointer.parent.glob("*.json")):
            raise CalibrationError(str(pointer), f"is missing: calibrate or fit {session} again")
        return None
    name = NAME.fullmatch(read_bounded(pointer, MAX_POINTER_BYTES))
    if name is None:
        what = f"does not hold the name of an artefact ({HASH_CHARS} hexadecimal digits and .json)"
        raise CalibrationError(str(pointer), what)
    path = pointer.with_name(name[1].decode())
    if not path.is_file():
        raise CalibrationError(str(pointer), f"names {path.name}, which is missing: calibrate or fit {session} again")
    return path
