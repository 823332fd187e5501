"""Original strokes and the presses that repeat them, paired one to one by name, as images on the same fields."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from calibrate.calibration import Calibration
from calibrate.compare.field import Field, Image
from calibrate.compare.presses import prepare_press
from calibrate.compare.simulate import simulated
from calibrate.errors import CaptureRefused
from calibrate.loop.images import KEYS, Key, Seen, seen
from calibrate.stroke.params import Params
from model.ccdbsm import DomainError
from model.protocol import StrokeModel
from sessions.errors import SessionDamaged
from sessions.reader import Capture


@dataclass(frozen=True, slots=True)
class Pair:
    """One stroke twice. Depth and tilt of `original` are as commanded, those of `again` as recovered."""

    original: Seen
    again: Seen
    simulated: dict[Key, Image]
    """The model's press at the recovered depth and tilt, (128, 128) each."""


@dataclass(frozen=True, slots=True)
class Paired:
    """Every pair, every original, and what could not be used."""

    pairs: list[Pair] = field(default_factory=list[Pair])
    originals: dict[str, Seen] = field(default_factory=dict[str, Seen])
    refused: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])
    """(stroke, why), never dropped in silence."""


@dataclass(frozen=True, slots=True)
class Side:
    """The captures of one session and how they are rectified."""

    captures: Iterator[Capture]
    calibration: Calibration | None


def pair_up(original: Side, again: Side, model: StrokeModel, view: Field) -> Paired:
    """Pair by `again_of`. Originals that were not pressed again are listed as such."""
    made = Paired()
    for stroke, _ in _seen(original, view, made):
        if stroke.stroke_id in made.originals:
            made.refused.append((stroke.stroke_id, "its name stands for two strokes: the first is used"))
        else:
            made.originals[stroke.stroke_id] = stroke
    repeated: set[str] = set()
    for stroke, of in _seen(again, view, made):
        if of is None or of not in made.originals:
            told = "repeats no stroke" if of is None else f"repeats {of}, which is not there or cannot be used"
            made.refused.append((stroke.stroke_id, told))
            continue
        try:
            drawn = {key: simulated(model, stroke.height_mm, stroke.tilt_deg, *key, view) for key in KEYS}
        except DomainError as error:
            made.refused.append((stroke.stroke_id, f"the model does not predict it: {error}"))
            continue
        repeated.add(of)
        made.pairs.append(Pair(made.originals[of], stroke, drawn))
    made.refused.extend((name, "was not pressed again") for name in made.originals if name not in repeated)
    return made


def _seen(side: Side, view: Field, made: Paired) -> Iterator[tuple[Seen, str | None]]:
    """(stroke, what it repeats) of every press that can be used."""
    params = Params(**side.calibration.preprocess) if side.calibration else Params()
    for capture in side.captures:
        stroke = capture.stroke
        if stroke.height_mm is None or stroke.tilt_deg is None:
            made.refused.append((stroke.stroke_id, "tells no depth or tilt"))
            continue
        try:
            prepared = prepare_press(capture, side.calibration, params, view)
            one = seen(stroke.stroke_id, stroke.height_mm, stroke.tilt_deg, prepared)
        except (CaptureRefused, SessionDamaged) as error:
            made.refused.append((stroke.stroke_id, error.what))
        else:
            yield one, stroke.again_of
