"""The calibration of a session: an immutable file named after the hash of its contents."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from calibrate.errors import CalibrationError
from calibrate.files import write_whole

SCHEMA_VERSION = 1
FOLDER = "calibration"
MAX_BYTES = 1024 * 1024
HASH_CHARS = 16


class Calibration(BaseModel):
    """What was measured, from which recording, with which software. Equal inputs give an equal file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = SCHEMA_VERSION
    session_id: str
    source: str
    """`loopback rig` or `real capture`, as the recording says."""
    recording_sha256: str
    software: str
    image_to_paper: tuple[float, float, float, float, float, float, float, float, float]
    """Homography, row by row: pixels (centres on integers) to mm in the paper frame."""
    mm_per_px: float
    """pix2len at the middle of the board."""
    mm_per_px_low: float
    mm_per_px_high: float
    """95 % interval."""
    rms_px: float
    corners: int
    corners_dropped: int
    """Outliers: seen, but not on the plane of the others."""
    preprocess: dict[str, float]

    def homography(self) -> NDArray[np.float64]:
        """`image_to_paper` as (3, 3)."""
        return np.array(self.image_to_paper).reshape(3, 3)

    @property
    def digest(self) -> str:
        """The first characters of the sha256 of the canonical JSON: the file's name."""
        return hashlib.sha256(self._canonical()).hexdigest()[:HASH_CHARS]

    def _canonical(self) -> bytes:
        return self.model_dump_json(indent=2).encode() + b"\n"

    def save(self, folder: Path) -> Path:
        """Write `<digest>.json` into `folder`; where it is there already, it is the same and stays."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.digest}.json"
        if not path.exists():
            write_whole(path, self._canonical().decode())
        return path


def load(path: Path) -> Calibration:
    """Read an artefact. Raises `CalibrationError` where it is none or was edited."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CalibrationError(str(path), f"is larger than {MAX_BYTES} bytes")
        data = path.read_bytes()
        calibration = Calibration.model_validate_json(data)
    except OSError as error:
        raise CalibrationError(str(path), error.strerror or str(error)) from None
    except ValidationError as error:
        first = error.errors()[0]
        raise CalibrationError(str(path), f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if hashlib.sha256(data).hexdigest()[:HASH_CHARS] != path.stem:
        raise CalibrationError(str(path), "was edited: its name is not the hash of its contents")
    return calibration


def newest(session: Path) -> Path | None:
    """The artefact written last in a session's folder, if there is one."""
    found = sorted((session / FOLDER).glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    return found[-1] if found else None
