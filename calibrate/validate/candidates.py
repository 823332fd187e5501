"""The models compared with captures: every registered one, the fitted brush, refits to other cells, generators."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.compare.place import Field, Pixels, brush_of, loop_pixels, simulated_pixels
from brushloop.calibrate.validate.heldout import Refit, bezier_pixels
from brushloop.calibrate.validate.sources import LoadedSession
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.fitted import NAME
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.model.strokes import StrokeModel

FITTED = NAME
PUBLISHED = "as published"
HELD_OUT = "fitted, held-out cells"
FITTED_HELD_OUT, BEZIER_REFITTED = "ccd-bsm-heldout", "bezier-refitted"
GENERATOR_HELD_OUT = "ccd-bsmg-heldout"
HELD_OUT_NAMES = (FITTED_HELD_OUT, BEZIER_REFITTED, GENERATOR_HELD_OUT)
LAMBDAS = {"ccd-bsm-lambda-1": 1.0, "ccd-bsm-lambda-pi/2": 0.5 * math.pi}
"""Values compared in addition to lambda = pi, which is CCD-BSM itself: the paper's figure 3."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A model to compare with one session: one row of the tables."""

    name: str
    label: str
    definition: str
    basis: str
    """What the model knows of these strokes: `as published`, `fitted, in sample`, `fitted, held-out cells`, ..."""
    predict: Callable[[Condition], Pixels]
    """(len(KEYS), 128, 128) of a condition; raises `DomainError` for a press that the model does not predict."""
    file: Path | None = None
    """File of a trained generator."""


@dataclass(frozen=True, slots=True)
class Generator:
    """A trained generator's file, and the hash of its contents."""

    path: Path
    sha256: str


def generator_file(path: Path) -> Generator:
    """A generator's file with its hash. Raises OSError."""
    with path.open("rb") as file:
        return Generator(path, hashlib.file_digest(file, "sha256").hexdigest())


def closed_forms(session: LoadedSession, view: Field, *, ablations: bool) -> list[Candidate]:
    """The registered models of the session's brush, the fitted one, and CCD-BSM at other lambdas."""
    from brushloop.model.fitted import fitted_model
    from brushloop.model.strokes import stroke_model, stroke_models

    brush = brush_of(session.header)
    found = [_of_model(model, PUBLISHED, view) for model in stroke_models(brush).values()]
    if session.fit is not None:
        fit = session.fit
        basis = "fitted, in sample" if fit.recording_sha256 == session.sha256 else f"fitted on {fit.session_id}"
        found.insert(1, _of_model(fitted_model(fit.press(), "CCD-BSM fitted"), basis, view))
    if ablations:
        for name, lam in LAMBDAS.items():
            label = f"CCD-BSM, λ = {name.rpartition('-')[2].replace('pi', 'π')}"
            found.append(_of_model(stroke_model("ccd-bsm", brush, lam), PUBLISHED, view, name, label))
    return found


def generators(session: LoadedSession, files: Sequence[Generator], view: Field) -> list[Candidate]:
    """Trained generators, drawn as their traced outlines. Raises what `load_generator` does."""
    from brushloop.model.generator.stroke import load_generator

    found: list[Candidate] = []
    for number, file in enumerate(files):
        model = load_generator(file.path, brush_of(session.header))
        name = (
            model.name if number == 0 or model.name not in {one.name for one in found} else f"{model.name}-{number + 1}"
        )
        images = "trained on exact images of CCD-BSM"
        basis = f"{images}, then tuned on captures" if model.fitted else images
        found.append(replace(_of_model(model, basis, view, name, model.label), file=file.path))
    return found


def held_out(fits: dict[Condition, Refit], brush: Brush, view: Field, *, fitted: bool) -> list[Candidate]:
    """Models fitted without the cell they predict; `fits` holds the result of a `refit_job` for each cell."""

    def predict_fitted(condition: Condition) -> Pixels:
        press = _without(fits, condition).press(float(brush.radius_mm), float(brush.length_mm))
        return loop_pixels(press.outline(condition.depth_mm, condition.tilt_deg), view)

    def predict_bezier(condition: Condition) -> Pixels:
        bezier = _without(fits, condition).bezier
        if bezier is None:
            raise _undetermined(condition)
        return bezier_pixels(bezier, condition, view)

    bezier = Candidate(
        BEZIER_REFITTED,
        "Bezier refitted",
        "Two mirrored cubic Bezier curves; ends, belly and shoulder regressed on the captures of all other cells.",
        HELD_OUT,
        predict_bezier,
    )
    ours = Candidate(
        FITTED_HELD_OUT,
        "CCD-BSM calibrated",
        "CCD-BSM's lengths with gains, powers, profile and edges fitted to the captures of all other cells.",
        HELD_OUT,
        predict_fitted,
    )
    return [ours, bezier] if fitted else [bezier]


def tuned(files: dict[Condition, Path], brush: Brush, view: Field, number: int) -> Candidate:
    """A generator tuned on all cells except the one it predicts."""
    from brushloop.model.generator.stroke import load_generator

    loaded: dict[Path, StrokeModel] = {}

    def predict(condition: Condition) -> Pixels:
        file = files[condition]
        if file not in loaded:
            loaded[file] = load_generator(file, brush)
        return simulated_pixels(loaded[file], condition.depth_mm, condition.tilt_deg, view)

    return Candidate(
        GENERATOR_HELD_OUT if number == 0 else f"{GENERATOR_HELD_OUT}-{number + 1}",
        "CCD-BSMG calibrated",
        "The generator, fine-tuned on captures of other cells (left out by fifths) and on images of the CCD-BSM that "
        "was fitted to them, if there is a fit; its outline.",
        HELD_OUT,
        predict,
    )


def _of_model(model: StrokeModel, basis: str, view: Field, name: str = "", label: str = "") -> Candidate:
    return Candidate(
        name or model.name,
        label or model.label,
        model.definition,
        basis,
        lambda condition: simulated_pixels(model, condition.depth_mm, condition.tilt_deg, view),
    )


def _without(fits: dict[Condition, Refit], condition: Condition) -> Refit:
    """What was fitted without a condition. Raises `DomainError` where the other conditions are too few."""
    if condition not in fits:
        raise _undetermined(condition)
    return fits[condition]


def _undetermined(condition: Condition) -> DomainError:
    why = "the other cells do not determine this press"
    return DomainError("depth_mm", condition.depth_mm, "other cells", why)
