"""The presses of a session, each found in its photograph once and laid on the millimetre field.

Fit, validation, inversion, loop and twin read presses from the session's store of finished work; what is not there yet
is prepared side by side and kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.compare import ANCHOR_MM, FIELD_MM, KEYS, brush_of, captured, field_around, field_grid, shrunk
from brushloop.calibrate.errors import CalibrationError, CaptureRefused
from brushloop.calibrate.report import source_label
from brushloop.calibrate.session import Calibration, OpenSession, open_session
from brushloop.calibrate.stroke import preprocess
from brushloop.calibrate.stroke.preprocess import PX_PER_MM, Gray, Measured, Prepared
from brushloop.calibrate.work import Arrays, Scheduler, key_of, threads
from brushloop.model.presses import Presses
from brushloop.sessions.errors import SessionDamaged
from brushloop.sessions.recording import Capture, Recording, bad_stills
from brushloop.sessions.records import Condition, Header, Stroke
from brushloop.sessions.terminal import Progress, counted, unseen

SPECK_SHARE = 0.002
"""Smallest share of a figure's ink that counts; lower than for a press, because a figure may have dots."""
LEAST_LEFT = 0.25
"""Smallest share of a press's ink that lies to the left of its touch."""
Refused = tuple[str, str]
"""(stroke, reason) of a capture that cannot be used: it is listed, never dropped in silence."""


@dataclass(frozen=True, slots=True)
class Press:
    """A captured press on the millimetre field."""

    session: str
    """Name of the session."""
    source: str
    """Label of its recording."""
    stroke: Stroke
    images: NDArray[np.uint8]
    """(len(KEYS), 128, 128): what is compared."""
    coverage: NDArray[np.float32]
    """(128, 128) share of each pixel of the millimetre field that is ink."""
    anchor_mm: tuple[float, float]
    """The zero-touch point, from the field's left and top edge."""
    measured: Measured
    cut: bool
    """Whether the stroke reaches the edge of its photograph, patch or field."""

    @property
    def condition(self) -> Condition:
        """What was commanded; 0 for what an import does not say (`uncommanded` refuses those)."""
        return Condition(self.stroke.depth_mm or 0.0, self.stroke.tilt_deg or 0.0)


def uncommanded(press: Press) -> str:
    """Refuse a press of unknown depth or tilt."""
    return "has no depth or tilt" if press.stroke.depth_mm is None or press.stroke.tilt_deg is None else ""


def cut(press: Press) -> str:
    """Refuse a press of which a part is missing."""
    return "is cut by the edge of its photograph, of its patch or of the crop around its touch" if press.cut else ""


def too_thin(press: Press) -> str:
    """Refuse a press that leaves one of the images blank."""
    thin = next((key for key, image in zip(KEYS, press.images, strict=True) if not image.any()), None)
    return "" if thin is None else f"is too thin to be seen in its {thin[1]} image ({thin[0]})"


def beside_touch(press: Press) -> str:
    """Refuse an imported press whose ink lies to the right of its touch point: every mark extends to the left of it."""
    left = round(press.anchor_mm[0] / FIELD_MM * press.coverage.shape[1])
    if press.stroke.anchor_px is None or press.coverage[:, :left].sum() >= LEAST_LEFT * press.coverage.sum():
        return ""
    return "lies to the right of its touch point (start_x_px): is its photograph turned or mirrored?"


def read_presses(
    session: OpenSession,
    refused: list[Refused],
    *unless: Callable[[Press], str],
    chosen: Collection[str] | None = None,
    scheduler: Scheduler | None = None,
    progress: Progress = unseen,
) -> Iterator[Press]:
    """Yield the presses of a session in order of capture, all or those of some names; the others go to `refused`.

    `unless` give the reason why a press cannot be used, empty if it can. Raises `SessionDamaged` for a recording that
    cannot be read; a photograph that cannot is refused.
    """
    store, bad = session.store, bad_stills(session.recording.path.parent)
    wanted = [k for k, stroke in enumerate(session.strokes) if chosen is None or stroke.stroke_id in chosen]
    keys = {k: key_of("press", session.sha256, session.calibration_digest, k) for k in wanted}
    kept = {key: store.get(key) for key in keys.values()}
    missing = {k for k, key in keys.items() if kept[key] is None}
    if missing:
        captures = enumerate(session.recording.captures())
        jobs = ((keys[k], (capture, session.calibration)) for k, capture in captures if k in missing)
        with nullcontext(scheduler) if scheduler else threads() as used:
            finished = used.finished(prepare_job, jobs, store)
            kept.update(counted(finished, f"{session.header.session_id}: found", len(missing), progress))
    for k in wanted:
        stroke, arrays = session.strokes[k], kept[keys[k]]
        assert arrays is not None, "it was prepared"
        press = None if "refused" in arrays else press_of(session.header, stroke, arrays)
        reasons = (why(press) for why in unless) if press is not None else (str(arrays["refused"]),)
        if reason := next(filter(None, (bad.get(stroke.still, ""), *reasons)), ""):
            refused.append((stroke.stroke_id, reason))
        elif press is not None:
            yield press


def read_for_fit(place: Path | Recording, progress: Progress = unseen) -> tuple[OpenSession, Presses, list[Refused]]:
    """Read every whole press of a session, and name the others.

    Raises `CalibrationError` where it holds none, or was not calibrated.
    """
    session, refused = open_session(place, "press"), list[Refused]()
    usable = list(read_presses(session, refused, uncommanded, beside_touch, cut, progress=progress))
    if not usable:
        why = ", first: {} {}".format(*refused[0]) if refused else ""
        raise CalibrationError(str(session.recording.path), f"holds no press that can be used for a fit{why}")
    return session, for_fit(usable, session.header), refused


def for_fit(presses: Sequence[Press], header: Header) -> Presses:
    """Presses of one session as a fit uses them: their ink on the millimetre field."""
    brush = brush_of(header)
    commands = [(press.condition.depth_mm, press.condition.tilt_deg) for press in presses]
    ink = np.array([press.coverage for press in presses], np.float64)
    return Presses(float(brush.radius_mm), float(brush.length_mm), field_grid(), np.array(commands), ink)


def prepare_job(job: tuple[Capture, Calibration | None]) -> Arrays:
    """The entry of a press in the store, its stroke resampled to the images that are compared.

    `refused` alone says why there is none.
    """
    try:
        prepared = prepare_press(*job)
    except (CaptureRefused, SessionDamaged) as error:
        return {"refused": np.array(error.what)}
    assert prepared.anchor_px is not None, "`prepare_press` refuses a stroke without one"
    return {
        "images": captured(prepared),
        "coverage": shrunk(prepared.mask.astype(np.float32)),
        "anchor_mm": np.array(prepared.anchor_px) / PX_PER_MM,
        "measured": np.array(astuple(preprocess.measure(prepared.mask))),
        "cut": np.array(prepared.cut),
    }


def press_of(header: Header, stroke: Stroke, arrays: Arrays) -> Press:
    """The press of an entry that is not `refused`."""
    x_mm, y_mm = arrays["anchor_mm"].tolist()
    return Press(
        header.session_id,
        source_label(header.source, [header.brush]),
        stroke,
        arrays["images"],
        arrays["coverage"],
        (x_mm, y_mm),
        Measured(*arrays["measured"].tolist()),
        bool(arrays["cut"]),
    )


def rectified(capture: Capture, calibration: Calibration | None) -> tuple[Gray, Prepared]:
    """The surroundings of a stroke at 20 px/mm, (h, w) gray, and what was found in them.

    A press is cropped to the field around its zero-touch point, a stroke that travels to its patch. A press in an
    imported photograph keeps the surroundings that the light is estimated from; without that point, or of a stroke that
    travels, the photograph is rescaled whole. Raises `CaptureRefused` for a capture that cannot be used,
    `SessionDamaged` for a picture that cannot be read.
    """
    stroke, image = capture.stroke, capture.image()
    if calibration is not None and stroke.anchor_mm is not None:
        window, (left_mm, top_mm) = field_around(stroke.anchor_mm), ANCHOR_MM
        if stroke.kind == "drag" and stroke.cell_mm is not None:
            window = x_mm, y_mm, _, tall_mm = stroke.cell_mm
            left_mm, top_mm = stroke.anchor_mm[0] - x_mm, y_mm + tall_mm - stroke.anchor_mm[1]
        raster = preprocess.rectify_by(image, calibration, window, capture.where)
        patch_px = None if stroke.cell_mm is None else preprocess.on_window(stroke.cell_mm, window)
        anchor = (left_mm * PX_PER_MM, top_mm * PX_PER_MM)
        return raster, preprocess.prepare(raster, anchor, capture.where, patch_px)
    if stroke.px_per_mm is None:
        raise CaptureRefused(stroke.stroke_id, "has neither a calibration nor a scale of its own")
    anchor_px = stroke.anchor_px
    if anchor_px is not None and stroke.kind == "press":
        before_mm, around_mm = np.array(ANCHOR_MM), 0.5 * preprocess.BACKGROUND_MM
        first = np.floor(anchor_px - (before_mm + around_mm) * stroke.px_per_mm)
        last = np.ceil(anchor_px + (FIELD_MM - before_mm + around_mm) * stroke.px_per_mm)
        (left, top), (right, bottom) = np.clip([first, last], 0, image.shape[::-1]).astype(int).tolist()
        image, anchor_px = image[top:bottom, left:right], (anchor_px[0] - left, anchor_px[1] - top)
        if not image.size:
            raise CaptureRefused(capture.where, preprocess.NOT_IN_FIELD)
    raster = preprocess.rescale(image, stroke.px_per_mm, capture.where)
    scale_x, scale_y = (PX_PER_MM / scale for scale in stroke.px_per_mm)
    anchor = None if anchor_px is None else (anchor_px[0] * scale_x, anchor_px[1] * scale_y)
    return raster, preprocess.prepare(raster, anchor, capture.where)


def prepare_press(capture: Capture, calibration: Calibration | None) -> Prepared:
    """Rectify a stroke to the millimetre field, whether or not it was marked bad: that may change, the result is kept.

    `cut` is set where ink lies outside the field. Raises as `rectified` does, and `CaptureRefused` if all of it does.
    """
    stroke = capture.stroke
    _, prepared = rectified(capture, calibration)
    if calibration is not None and stroke.anchor_mm is not None:
        return prepared
    anchor_px = prepared.anchor_px
    if anchor_px is None:
        raise CaptureRefused(stroke.stroke_id, "has no touch point (start_x_px, start_y_px) to align it with a model")
    side, (height, width) = round(FIELD_MM * PX_PER_MM), prepared.mask.shape
    left, top = (
        min(max(round(at - away_mm * PX_PER_MM), -side), most)
        for at, away_mm, most in zip(anchor_px, ANCHOR_MM, (width, height), strict=True)
    )
    window = slice(top + side, top + 2 * side), slice(left + side, left + 2 * side)
    mask, soft = (np.pad(part, side)[window] for part in (prepared.mask, prepared.soft))
    if not mask.any():
        raise CaptureRefused("anchor", preprocess.NOT_IN_FIELD)
    cut = prepared.cut or bool(np.count_nonzero(mask) < np.count_nonzero(prepared.mask))
    return replace(prepared, mask=mask, soft=soft, anchor_px=(anchor_px[0] - left, anchor_px[1] - top), cut=cut)


def prepare_patch(capture: Capture, calibration: Calibration) -> Prepared:
    """Rectify a whole patch: all ink in it belongs to its figure, however far apart the strokes are.

    Raises `CaptureRefused` for a stroke without a patch, or without ink in it.
    """
    cell_mm = capture.stroke.cell_mm
    if cell_mm is None:
        raise CaptureRefused(capture.stroke.stroke_id, "has no patch")
    raster = preprocess.rectify_by(capture.image(), calibration, cell_mm, capture.where)
    return preprocess.prepare(raster, None, capture.where, join_mm=math.hypot(*cell_mm[2:]), speck_share=SPECK_SHARE)
