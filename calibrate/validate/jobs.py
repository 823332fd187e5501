"""Work of the workers: pure functions of picklable jobs, run here or on another machine; and the prepared presses.

Nothing here imports torch, which preparing and scoring do not need.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.calibration import Calibration
from brushloop.calibrate.compare.place import (
    KEYS,
    Field,
    captured_images,
    covered,
    pack,
    prepare_press,
    to_pixels,
    unpack,
)
from brushloop.calibrate.compare.score import similarity
from brushloop.calibrate.errors import CaptureRefused
from brushloop.calibrate.scores import Values
from brushloop.calibrate.stroke.measure import Measured, measure
from brushloop.calibrate.validate.store import VERSION, Store
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.calibrate.pool import Scheduler
    from brushloop.calibrate.validate.sources import LoadedSession
    from brushloop.sessions.terminal import Progress

ABSENT = b""
"""Placeholder for the images of a model that does not predict this press."""


@dataclass(frozen=True, slots=True)
class PrepareJob:
    """Find the stroke in its photograph and resample it to the pixels that are compared."""

    capture: Capture
    calibration: Calibration | None
    view: Field


@dataclass(frozen=True, slots=True)
class Press:
    """A captured press after preparation; `pixels` is empty if it was refused."""

    stroke_id: str
    condition: Condition
    """As commanded."""
    again_of: str
    pixels: bytes
    """`pack` of (len(KEYS) + 1, 128, 128): an image for each key, then the coverage on the millimetre field."""
    measured: Measured | None
    cut: bool
    flags: tuple[str, ...]
    refused: str

    def to_body(self) -> dict[str, Any]:
        """Return the press as plain data."""
        return asdict(self)


def press_of(body: dict[str, Any]) -> Press:
    """A press from plain data."""
    rest: dict[str, Any] = {
        "condition": Condition(**body["condition"]),
        "measured": Measured(**body["measured"]) if body["measured"] else None,
        "flags": tuple(body["flags"]),
    }
    return Press(**(body | rest))


def prepare_job(job: PrepareJob) -> Press:
    """Prepare a capture; one that cannot be used comes back with the reason."""
    stroke = job.capture.stroke
    condition, again = Condition(stroke.depth_mm or 0.0, stroke.tilt_deg or 0.0), stroke.again_of or ""

    def refused(why: str) -> Press:
        return Press(stroke.stroke_id, condition, again, b"", None, False, (), why)

    if stroke.depth_mm is None or stroke.tilt_deg is None:
        return refused("has no depth or tilt")
    try:
        prepared = prepare_press(job.capture, job.calibration, job.view)
        images = captured_images(stroke.stroke_id, prepared)
    except (CaptureRefused, SessionDamaged) as error:
        return refused(error.what)
    pixels = pack(np.stack([to_pixels(image) for image in (*images.values(), covered(prepared))]))
    measured = measure(prepared.mask)
    return Press(stroke.stroke_id, condition, again, pixels, measured, prepared.cut, prepared.flags, "")


def _key_of(session: LoadedSession, view: Field) -> str:
    """The beginning of the keys of a session's prepared strokes; `:` and the number of the stroke follow."""
    calibration = session.calibration.digest if session.calibration is not None else ""
    bad = sorted(session.recording.marked_bad().items())
    return hashlib.sha256(f"prepare {VERSION} {session.sha256} {calibration} {view} {bad}".encode()).hexdigest()


def prepared(
    session: LoadedSession, view: Field, scheduler: Scheduler, store: Store, progress: Progress
) -> Iterator[tuple[str, Press]]:
    """Every stroke of a session by its key, without pixels, in order of capture; what the store lacks is prepared."""
    base = _key_of(session, view)
    what = f"{session.header.session_id}: found"
    every = range(session.count)
    waiting = np.fromiter((f"{base}:{k}" not in store for k in every), np.bool_, session.count)
    done = session.count - int(waiting.sum())

    def put(number: str, press: Press) -> None:
        nonlocal done
        store.put(f"{base}:{number}", press.to_body())
        waiting[int(number)] = False
        done += 1
        progress(what, done, session.count)

    if waiting.any():

        def jobs() -> Iterator[tuple[str, PrepareJob]]:
            for k, capture in zip(every, session.recording.captures(), strict=True):
                if waiting[k]:
                    yield str(k), PrepareJob(capture, session.calibration, view)

        for number, press in scheduler.run(prepare_job, jobs()):
            put(number, press)
    for k in every:
        yield f"{base}:{k}", press_of(store.get(f"{base}:{k}") | {"pixels": b""})


@dataclass(frozen=True, slots=True)
class ScoreJob:
    """Compare presses of one cell with every prediction, and with other presses."""

    presses: tuple[bytes, ...]
    """`Press.pixels` of the presses to score."""
    predictions: tuple[bytes, ...]
    """One for each model: `pack` of (len(KEYS), 128, 128), or ABSENT."""
    others: tuple[bytes, ...]
    """`Press.pixels` of presses of the same cell that serve as predictions."""
    predicted_by: tuple[tuple[int, ...], ...]
    """For each press, the indices of the `others` that predict it; empty if none does."""
    originals: tuple[bytes, ...]
    """For each press, the press that it repeats, or ABSENT."""

    @property
    def key(self) -> str:
        """Hash of everything that determines the scores."""
        digest = hashlib.sha256(f"score {VERSION} {self.predicted_by}".encode())
        for group in (self.presses, self.predictions, self.others, self.originals):
            for item in group:
                digest.update(hashlib.sha256(item).digest())
            digest.update(b"|")
        return digest.hexdigest()


def score_job(job: ScoreJob) -> Values:
    """(presses, models + 2, KEYS, 2): CSIM and SSIM of each model, another press (averaged), and the original.

    NaN where there is nothing to compare with.
    """
    out = np.full((len(job.presses), len(job.predictions) + 2, len(KEYS), 2), np.nan)
    present = [m for m, packed in enumerate(job.predictions) if packed != ABSENT]
    predicted = [unpack(job.predictions[m]) for m in present]
    others = [unpack(packed) for packed in job.others]
    for n, packed in enumerate(job.presses):
        captured = unpack(packed)
        if present:
            out[n, present] = scores(captured, predicted)
        if job.predicted_by[n]:
            out[n, -2] = scores(captured, [others[k] for k in job.predicted_by[n]]).mean(axis=0)
        if job.originals[n] != ABSENT:
            out[n, -1] = scores(captured, [unpack(job.originals[n])])[0]
    return out


def scores(captured: NDArray[np.uint8], predicted: Sequence[NDArray[np.uint8]]) -> Values:
    """(M, KEYS, 2) CSIM and SSIM of one press, (at least KEYS, 128, 128), against M predictions of that shape.

    In the size-normalised alignment each prediction first takes its best shift. NaN where an image is blank.
    """
    out = np.full((len(predicted), len(KEYS), 2), np.nan)
    for k, (alignment, _tone) in enumerate(KEYS):
        image = captured[k] / 255.0
        for m, other in enumerate(predicted):
            if image.any() and other[k].any():
                out[m, k] = similarity(image, other[k] / 255.0, alignment)
    return out
