"""`twin.toml`, which `brushloop sim --brush` presses with and the command prints, and the camera's noise.

The noise comes from stills of one view: what differs between two of them where nothing was drawn.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import made_by
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Recording
from brushloop.twin.run import Twin

STILLS = 8
"""Stills that are compared, each with the next one."""
TO_SD = 1.4826
"""Standard deviation of normally distributed values over their median absolute deviation."""
JPEG_QUALITY = 95
PAPER_GRAY = 215
TRIED = np.arange(0.0, 12.1, 0.5)


def twin_toml(twin: Twin, session_id: str, noise_gray: float | None) -> str:
    """The text of `twin.toml`: every constant of the brush, and what is known of it as a comment."""
    return "\n".join(_lines(twin, session_id, noise_gray)) + "\n"


def _lines(twin: Twin, session_id: str, noise_gray: float | None) -> Iterator[str]:
    plain = "".join(char if char.isprintable() and char not in '"\\' else "?" for char in session_id)
    yield f"# Made by `brushloop twin` ({made_by()}); press with it: brushloop sim --brush FILE."
    yield "# Everything that it presses is simulated. Intervals hold about 95 %: docs/loopback-brush.md."
    yield f'name = "simulated bristle bundle (twin of {plain[:60]}, simulated)"'
    if noise_gray is None:
        yield "# The camera's noise was not measured: no two stills show the same view."
    else:
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
        yield f"{one.constant.name} = {one.value:.6g}    # {unit}{known}; default {one.constant.default:.4g}"
    for row in twin.held_out:
        scores = f"CSIM {row.csim:.2f} %, SSIM {row.ssim:.2f} %, n = {row.n}"
        yield f"# a third of the cells left out in turn: {row.model}: {scores}"
    if twin.spread is None:
        yield "# No cell has three captures: how presses differ is left as in the default brush."
    else:
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
