"""Immutable files named after the hash of their contents, and the calibration of a session, which is one."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from calibrate.board.lens import Lens, lens_of
from calibrate.board.scale import BoardSpec, apply
from calibrate.errors import CalibrationError, invalid
from calibrate.files import read_bounded, write_whole

SCHEMA_VERSION = 2
"""Of a calibration: 2 names the lens, the board and the still, and tells where it was made for another session."""
FOLDER = "calibration"
HASH_CHARS = 16


class Artefact(BaseModel):
    """Base: frozen, nothing unknown is let in, saved under the hash of its canonical JSON."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    versions: ClassVar[tuple[int, ...]] = (1,)
    """Values of `schema_version` that are read."""

    @property
    def digest(self) -> str:
        """The first characters of the sha256 of the canonical JSON: the file's name."""
        return hashlib.sha256(self._canonical()).hexdigest()[:HASH_CHARS]

    def _canonical(self) -> bytes:
        return self.model_dump_json(indent=2).encode() + b"\n"

    def save(self, folder: Path) -> Path:
        """Write `<digest>.json` into `folder`; where it is there already, it is the same and stays. Raises OSError."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.digest}.json"
        if not path.exists():
            write_whole(path, self._canonical().decode())
        return path


A = TypeVar("A", bound=Artefact)


def load_artefact(path: Path, kind: type[A]) -> A:
    """Read an artefact of this kind. Raises `CalibrationError` where it is none, was edited or is too new."""
    data = read_bounded(path)
    version = _version(data)
    if isinstance(version, int) and version not in kind.versions:
        known = ", ".join(map(str, kind.versions))
        raise CalibrationError(str(path), f"schema_version: {version} is not one that is read here ({known}): update")
    try:
        made = kind.model_validate_json(data)
    except ValidationError as error:
        raise invalid(str(path), error) from None
    if hashlib.sha256(data).hexdigest()[:HASH_CHARS] != path.stem:
        raise CalibrationError(str(path), "was edited: its name is not the hash of its contents")
    return made


def _version(data: bytes) -> object:
    try:
        parsed: Any = json.loads(data)
    except (ValueError, RecursionError):
        return None  # said better by the model
    return cast("dict[str, Any]", parsed).get("schema_version") if isinstance(parsed, dict) else None


class LensUsed(BaseModel):
    """The lens by which photographs are straightened, and where it is known from."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    source: str
    """`lens file <hash>`, or `k1 fitted on the board` where no lens was known and none was missed."""
    size_px: tuple[int, int]
    """Width and height of the photographs that it holds for."""
    matrix: tuple[float, float, float, float]
    """fx, fy, cx, cy in pixels, pixel centres on integers."""
    distortion: tuple[float, float, float, float, float]
    """k1, k2, p1, p2, k3 of OpenCV's model."""

    def lens(self) -> Lens:
        """To look through."""
        return lens_of(self.matrix, self.distortion, self.size_px)

    @classmethod
    def of(cls, lens: Lens, source: str) -> LensUsed:
        """What stands in a file of a lens."""
        m, d = lens.matrix, [float(v) for v in lens.distortion]
        return cls(
            source=source,
            size_px=lens.size_px,
            matrix=(float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])),
            distortion=(d[0], d[1], d[2], d[3], d[4]),
        )


class Foreign(BaseModel):
    """Another session's calibration, applied by force: where it comes from, and how far off it is here."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    digest: str
    """Of the artefact that was applied."""
    session_id: str
    source: str
    recording_sha256: str
    board_off_mm: float | None
    """Root mean square by which this session's own board lies off under it; missing where no board is seen."""


class Calibration(Artefact):
    """What was measured, from which recording, with which software. Equal inputs give an equal file."""

    versions: ClassVar[tuple[int, ...]] = (1, 2)

    schema_version: int = SCHEMA_VERSION
    session_id: str
    source: str
    """`loopback rig` or `real capture`, as the recording says."""
    recording_sha256: str
    software: str
    image_to_paper: tuple[float, float, float, float, float, float, float, float, float]
    """Homography, row by row: pixels (centres on integers) of the straightened photograph to mm in the paper frame."""
    mm_per_px: float
    """pix2len in the middle of the corners that were seen."""
    mm_per_px_low: float
    mm_per_px_high: float
    """95 % interval."""
    rms_px: float
    corners: int
    corners_dropped: int
    """Outliers: seen, but not on the plane of the others."""
    preprocess: dict[str, float]
    lens: LensUsed | None = None
    """By which photographs are straightened first; none in files of version 1, which knew no lens."""
    middle_px: tuple[float, float] | None = None
    """Where `mm_per_px` holds, in the photograph as it was taken."""
    board: BoardSpec | None = None
    still_sha256: str = ""
    """Of the encoded photograph of the board that this was measured on."""
    flags: tuple[str, ...] = ()
    """What was not as it should be with that photograph: partly hidden, saturated."""
    foreign: Foreign | None = None

    def homography(self) -> NDArray[np.float64]:
        """`image_to_paper` as (3, 3)."""
        return np.array(self.image_to_paper).reshape(3, 3)

    def to_image(self, paper_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) mm in the paper frame -> pixels of the photograph as it was taken."""
        straight = apply(np.asarray(np.linalg.inv(self.homography()), np.float64), paper_mm)
        return straight if self.lens is None else self.lens.lens().bent(straight)

    def to_paper(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) pixels of the photograph as it was taken -> mm in the paper frame."""
        return apply(self.homography(), pixels if self.lens is None else self.lens.lens().straight(pixels))

    @property
    def named(self) -> str:
        """For reports: the digest, and the label where there is one."""
        return f"{self.digest}, {self.label}" if self.label else self.digest

    @property
    def label(self) -> str:
        """What every result must say of it; empty for a session's own."""
        if self.foreign is None:
            return ""
        off = (
            "" if self.foreign.board_off_mm is None else f", its board lies {self.foreign.board_off_mm:.2f} mm off here"
        )
        return f"foreign calibration: {self.foreign.digest} of {self.foreign.session_id} ({self.foreign.source}){off}"
