"""`twin.toml`, which `brushloop sim --brush` presses with, and the file that lets an interrupted run continue."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded, write_whole
from brushloop.twin.constants import SHAPE
from brushloop.twin.run import Twin
from brushloop.twin.shape import Found

Coordinates = Annotated[tuple[float, ...], Field(min_length=len(SHAPE) + 3, max_length=len(SHAPE) + 3)]


class _Step(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    point: Coordinates
    seed: Annotated[int, Field(ge=0)]


class Notes(BaseModel):
    """Finished steps of a run, beside the file that it will write; valid for the same captures and software only."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    recording_sha256: str
    calibration: str
    mm_per_px: float
    software: str
    steps: dict[str, _Step] = {}

    def found(self) -> dict[str, Found]:
        """The steps as the search takes them."""
        return {name: Found(np.array(step.point), step.seed) for name, step in self.steps.items()}

    def with_step(self, name: str, found: Found) -> Notes:
        """The same with one more step."""
        step = _Step(point=tuple(map(float, found.point)), seed=found.seed)
        return self.model_copy(update={"steps": {**self.steps, name: step}})


def notes_path(out: Path) -> Path:
    """Where the notes of the run that will write `out` are kept."""
    return out.with_name(f"{out.name}.unfinished.json")


def resumed(path: Path, fresh: Notes) -> Notes:
    """The notes at `path` if they belong to the same captures and software, else `fresh`. Raises `CalibrationError`."""
    if not path.exists():
        return fresh
    try:
        old = Notes.model_validate_json(read_bounded(path))
    except ValidationError:
        raise CalibrationError(str(path), "is not the file of an interrupted `brushloop twin`: move it away") from None
    return old if old.model_copy(update={"steps": {}}) == fresh else fresh


def save_notes(path: Path, notes: Notes) -> None:
    """Write the notes whole. Raises OSError."""
    write_whole(path, notes.model_dump_json(indent=1) + "\n")


def twin_name(session_id: str) -> str:
    """The name under which everything that the twin presses is recorded."""
    plain = "".join(char if char.isprintable() and char not in '"\\' else "?" for char in session_id)
    return f"simulated bristle bundle (twin of {plain[:60]}, simulated)"


def twin_toml(twin: Twin, session_id: str, noise_gray: float | None) -> str:
    """The text of `twin.toml`: every constant of the brush, and what is known of it as a comment."""
    return "\n".join(_lines(twin, session_id, noise_gray)) + "\n"


def _lines(twin: Twin, session_id: str, noise_gray: float | None) -> Iterator[str]:
    yield f"# Made by `brushloop twin` (brushloop {version('brushloop')}); press with it: brushloop sim --brush FILE."
    yield "# Everything that it presses is simulated. Intervals hold about 95 %: docs/loopback-brush.md."
    yield f'name = "{twin_name(session_id)}"'
    if noise_gray is not None:
        yield ""
        yield "[camera]"
        yield f"noise = {noise_gray:.2f}    # gray levels, from pairs of stills"
    if twin.head is not None:
        yield ""
        yield "[quality]"
        yield f"head_mm = {twin.head.head_mm:g}    # where its marks begin behind the point of touch, in the middle"
        yield f"misplaced_mm = {twin.head.misplaced_mm:g}    # the farthest from there, and a margin"
    yield ""
    yield "[brush]"
    yield f"radius_mm = {twin.spec.radius_mm:g}    # as recorded with the session"
    yield f"length_mm = {twin.spec.length_mm:g}    # as recorded with the session"
    yield f"seed = {twin.spec.seed}    # of the individuals tried, the one nearest to the captures"
    for one in twin.estimates:
        known = f"{one.low:.4g} to {one.high:.4g}"
        if not one.determined:
            known += ", not determined by these presses"
        unit = f"{one.constant.unit}; " if one.constant.unit else ""
        yield f"{one.constant.name} = {one.value:.6g}    # {unit}{known}"
    for row in twin.held_out:
        yield f"# cells left out: {row.model}: CSIM {row.csim:.2f} %, SSIM {row.ssim:.2f} %, n = {row.n}"
    if twin.spread is not None:
        yield (
            f"# two presses of a cell: CSIM {twin.spread.captured_percent:.2f} % captured, "
            f"{twin.spread.twin_percent:.2f} % from the twin"
        )
