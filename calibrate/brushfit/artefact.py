"""The fitted brush on disk: an immutable file named after the hash of its contents, as a calibration is."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from calibrate.errors import CalibrationError
from calibrate.files import write_whole
from model.fitted import MODES, NAMES, TERMS, FittedPress

SCHEMA_VERSION = 1
FOLDER = "brushfit"
MAX_BYTES = 1024 * 1024
HASH_CHARS = 16


class FittedValue(BaseModel):
    """One parameter; the interval is missing where the stage that frees it was refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    value: float
    low: float | None
    high: float | None
    """95 % interval, by bootstrap over strokes."""


class FittedStage(BaseModel):
    """A stage of the fit; `condition` is missing where it is infinite."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    condition: float | None
    refused: bool


class BrushFit(BaseModel):
    """What was fitted, to which strokes, with which software. Equal inputs give an equal file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_version: int = SCHEMA_VERSION
    session_id: str
    source: str
    recording_sha256: str
    calibration: str
    """Digest of the calibration that the captures were rectified with; empty for an import."""
    software: str
    radius_mm: float
    length_mm: float
    strokes: int
    mm_per_px: float
    parameters: dict[str, FittedValue]
    edges_mm: tuple[tuple[tuple[float, ...], ...], ...]
    stages: tuple[FittedStage, ...]
    proportional_h0_mm: float
    """Zero offset where every size is held proportional to depth: the absolute one, see docs/brushfit.md."""
    proportional_h0_se_mm: float
    csim_percent: dict[str, float]
    """Leave-cell-out CSIM by model."""

    def press(self) -> FittedPress:
        """The brush."""
        values = np.array([self.parameters[name].value for name in NAMES])
        return FittedPress(self.radius_mm, self.length_mm, values, np.array(self.edges_mm))

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


def load(path: Path) -> BrushFit:
    """Read an artefact. Raises `CalibrationError` where it is none, was edited, or is of another version."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CalibrationError(str(path), f"is larger than {MAX_BYTES} bytes")
        data = path.read_bytes()
        fit = BrushFit.model_validate_json(data)
    except OSError as error:
        raise CalibrationError(str(path), error.strerror or str(error)) from None
    except ValidationError as error:
        first = error.errors()[0]
        raise CalibrationError(str(path), f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
    if hashlib.sha256(data).hexdigest()[:HASH_CHARS] != path.stem:
        raise CalibrationError(str(path), "was edited: its name is not the hash of its contents")
    shape = (2, MODES, TERMS)
    if set(fit.parameters) != set(NAMES) or np.array(fit.edges_mm).shape != shape:
        raise CalibrationError(str(path), f"parameters: expected {', '.join(NAMES)}, and edges of shape {shape}")
    return fit


def newest(session: Path) -> Path | None:
    """The artefact written last in a session's folder, if there is one."""
    found = sorted((session / FOLDER).glob("*.json"), key=lambda path: path.stat().st_mtime_ns)
    return found[-1] if found else None
