"""`twin.toml`, which `brushloop sim --brush` presses with, the file of an interrupted run, and the camera's noise.

The noise comes from stills of one view: what differs between two of them where nothing was drawn.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError

from brushloop.calibrate.artefact import Frozen, made_by
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import read_bounded, write_whole
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Recording
from brushloop.twin.brush import SHAPE
from brushloop.twin.run import Twin
from brushloop.twin.search import Found

STILLS = 8
"""Stills that are compared, each with the next one."""
TO_SD = 1.4826
"""Standard deviation of normally distributed values over their median absolute deviation."""
JPEG_QUALITY = 95
PAPER_GRAY = 215
TRIED = np.arange(0.0, 12.1, 0.5)


class Step(Frozen):
    """A finished step: the point that the search has reached, and the seed of the individual."""

    point: Annotated[
        tuple[Annotated[float, Field(allow_inf_nan=False)], ...],
        Field(min_length=len(SHAPE) + 3, max_length=len(SHAPE) + 3),
    ]
    seed: Annotated[int, Field(ge=0)]


class Steps(Frozen):
    """Finished steps of a run by name; valid for the same captures and software only."""

    made_of: tuple[str, ...]
    steps: dict[str, Step]


class Notes:
    """The finished steps of a run, kept beside the file that it will write until that is written.

    Raises `CalibrationError` for a file that is not one of an interrupted run; that of other captures is not used.
    """

    def __init__(self, out: Path, *made_of: str) -> None:
        self.path = out.with_name(f"{out.name}.unfinished.json")
        self._made_of, self._steps = made_of, dict[str, Step]()
        if self.path.exists():
            try:
                saved = Steps.model_validate_json(read_bounded(self.path))
            except ValidationError:
                what = "is not the file of an interrupted `brushloop twin`: move it away"
                raise CalibrationError(str(self.path), what) from None
            if saved.made_of == made_of:
                self._steps |= saved.steps

    def known(self, name: str, work: Callable[[], Found]) -> Found:
        """The result of a step, from the file or else from the work, which is then written. Raises OSError."""
        if name in self._steps:
            return Found(np.array(self._steps[name].point), self._steps[name].seed)
        found = work()
        self._steps[name] = Step(point=tuple(found.point.tolist()), seed=found.seed)
        write_whole(self.path, Steps(made_of=self._made_of, steps=self._steps).model_dump_json(indent=1) + "\n")
        return found


def twin_toml(twin: Twin, session_id: str, noise_gray: float | None) -> str:
    """The text of `twin.toml`: every constant of the brush, and what is known of it as a comment."""
    return "\n".join(_lines(twin, session_id, noise_gray)) + "\n"


def _lines(twin: Twin, session_id: str, noise_gray: float | None) -> Iterator[str]:
    plain = "".join(char if char.isprintable() and char not in '"\\' else "?" for char in session_id)
    yield f"# Made by `brushloop twin` ({made_by()}); press with it: brushloop sim --brush FILE."
    yield "# Everything that it presses is simulated. Intervals hold about 95 %: docs/loopback-brush.md."
    yield f'name = "simulated bristle bundle (twin of {plain[:60]}, simulated)"'
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
        known = f"{one.low:.4g} to {one.high:.4g}" if one.determined else "not determined by these presses"
        unit = f"{one.constant.unit}; " if one.constant.unit else ""
        yield f"{one.constant.name} = {one.value:.6g}    # {unit}{known}"
    for row in twin.held_out:
        yield f"# cells left out: {row.model}: CSIM {row.csim:.2f} %, SSIM {row.ssim:.2f} %, n = {row.n}"
    if twin.spread is not None:
        yield (
            f"# two presses of a cell: CSIM {twin.spread.captured_percent:.2f} % captured, "
            f"{twin.spread.twin_percent:.2f} % from the twin"
        )


def noise_gray(recording: Recording) -> float | None:
    """The noise of a session's camera in gray levels, from its first stills; None for imports, or a single still.

    An import may hold one picture from each of several views.
    """
    if recording.header.source.imported:
        return None
    stills: list[NDArray[np.uint8]] = []
    for capture in recording.captures():
        with contextlib.suppress(SessionDamaged):
            stills.append(capture.image())
        if len(stills) == STILLS:
            break
    return noise_of(stills)


def noise_of(stills: Sequence[NDArray[np.uint8]]) -> float | None:
    """Standard deviation in gray levels that the simulated camera needs to be as noisy; None if no two show one view.

    Each pixel's difference between two stills (h, w) has the noise of both; places where ink was added are left out.
    The simulated camera compresses its pictures, which takes away part of the noise: the value is the one that leaves
    as much after compression.
    """
    apart = [_difference(a, b) for a, b in pairwise(stills) if a.shape == b.shape]
    return float(np.interp(np.median(apart), [_left_after_jpeg(sd) for sd in TRIED], TRIED)) if apart else None


def _difference(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    moved = a.astype(np.float32) - b.astype(np.float32)
    # a median of whole gray levels is coarse: the mean of what lies within a few levels is not
    near = moved[np.abs(moved) <= max(4.0 * TO_SD * float(np.median(np.abs(moved))), 4.0)]
    return float(near.std()) / np.sqrt(2.0)


def _left_after_jpeg(sd: float) -> float:
    rng = np.random.default_rng(0)
    flat = np.clip(PAPER_GRAY + rng.normal(0.0, sd, (128, 128)), 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", flat, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return float(np.std(np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE), np.float64)))
