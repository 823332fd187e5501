"""Compare a session with the one that pressed its strokes again: paired by name, on the same fields, and scored."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare.place import Field, brush_of, simulated
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.loop.scores import Pair, PairScore, Verdict, score_pairs, verdicts
from brushloop.calibrate.presses import Press, Refused, read_presses, too_thin, uncommanded
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.model.ccdbsm import DomainError
from brushloop.sessions.records import Header, Source
from brushloop.sessions.terminal import Progress, unseen

if TYPE_CHECKING:
    from brushloop.model.strokes import StrokeModel

NOT_AGAIN = "was not pressed again"


@dataclass(frozen=True, slots=True)
class LoopComparison:
    """The result of pressing a session's strokes again."""

    original: OpenSession
    again: OpenSession
    model: str
    """The model that recovered, or is assumed to have recovered, depth and tilt, and drew the generated images."""
    in_sample: bool
    """Whether that model was fitted to the original presses themselves."""
    field: Field
    pairs: list[Pair]
    refused: list[Refused]
    scores: list[PairScore]
    verdicts: list[Verdict]


def compare_sessions(
    original: Path, again: Path, fit: Path | None, view: Field, progress: Progress = unseen
) -> LoopComparison:
    """Compare pair by pair. Raises `CalibrationError` where the two do not belong together."""
    first, second = open_session(original, kind="press"), open_session(again, kind="press")
    where = str(second.recording.path)
    if (first.header.source == Source.LOOPBACK) != (second.header.source == Source.LOOPBACK):
        raise CalibrationError(where, f"is {second.header.source}, the original {first.header.source}")
    repeated = _replayed(second.header)
    if repeated != first.header.session_id:
        what = "is not a replay" if repeated is None else f"repeats {repeated}"
        raise CalibrationError(where, f"{what}, not {first.header.session_id}")
    model, fitted_to = _model(first.header, fit)
    refused: list[Refused] = []
    every, repetitions = (
        list(read_presses(session, view, refused, uncommanded, too_thin, progress=progress))
        for session in (first, second)
    )
    originals = by_name(every, refused)
    pairs = pair_up(originals, repetitions, model, view, refused)
    if not pairs:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(where, f"not one pair can be compared{why}")
    progress("compared", 0, 1)
    scores = score_pairs(pairs, originals.values())
    progress("compared", 1, 1)
    in_sample = fitted_to == first.sha256
    return LoopComparison(first, second, model.label, in_sample, view, pairs, refused, scores, verdicts(scores))


def by_name(originals: Iterable[Press], refused: list[Refused]) -> dict[str, Press]:
    """The original presses by name; further ones of a name go to `refused`."""
    presses: dict[str, Press] = {}
    for press in originals:
        if presses.setdefault(press.stroke.stroke_id, press) is not press:
            refused.append((press.stroke.stroke_id, "two strokes have this name: the first is used"))
    return presses


def pair_up(
    originals: dict[str, Press], repetitions: Iterable[Press], model: StrokeModel, view: Field, refused: list[Refused]
) -> list[Pair]:
    """Pair presses by `again_of`. Those without a partner, originals included, go to `refused`."""
    pairs: list[Pair] = []
    for press in repetitions:
        name, of = press.stroke.stroke_id, press.stroke.again_of
        if of is None or of not in originals:
            why = "repeats no stroke" if of is None else f"repeats {of}, which does not exist or cannot be used"
            refused.append((name, why))
            continue
        try:
            images = simulated(model, press.condition.depth_mm, press.condition.tilt_deg, view)
        except DomainError as error:
            refused.append((name, f"the model does not predict it: {error}"))
            continue
        pairs.append(Pair(originals[of], press, images))
    repeated = {pair.original.stroke.stroke_id for pair in pairs}
    refused.extend((name, NOT_AGAIN) for name in originals if name not in repeated)
    return pairs


def _replayed(header: Header) -> str | None:
    """The session that a replay protocol repeats; None for any other."""
    try:
        protocol: Any = json.loads(header.protocol)
        return str(protocol["of"]) if protocol["kind"] == "replay" else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def _model(header: Header, fit: Path | None) -> tuple[StrokeModel, str]:
    """The model and the digest of the recording that it was fitted to, empty for none."""
    if fit is None:
        from brushloop.model.strokes import stroke_model

        return stroke_model("ccd-bsm", brush_of(header)), ""
    artefact = load_artefact(fit, BrushFit)
    from brushloop.model.fitted import fitted_model

    return fitted_model(artefact.press(), f"CCD-BSM fitted on {artefact.session_id}"), artefact.recording_sha256
