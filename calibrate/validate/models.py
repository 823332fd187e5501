"""The models compared with captures: every registered one, the fitted brush, refits to other cells, generators."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from brushloop.calibrate.artefact import Frozen
from brushloop.calibrate.compare import Pixels, brush_of, images_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.fit.fit import BrushFit
from brushloop.calibrate.session import OpenSession
from brushloop.calibrate.stats import CEILING
from brushloop.calibrate.work import Store, key_of
from brushloop.model.ccdbsm import DomainError
from brushloop.model.fitted import NAME as FITTED
from brushloop.model.outline import Outline
from brushloop.model.presses import Cell, Draw
from brushloop.sessions.disk import file_sha256
from brushloop.sessions.records import Condition

if TYPE_CHECKING:
    from brushloop.model.strokes import StrokeModel

PUBLISHED = "as published"
HELD_OUT = "fitted, held-out cells"
PRESSES = "captured presses"
FITTED_HELD_OUT, BEZIER_REFITTED = "ccd-bsm-heldout", "bezier-refitted"
ANOTHER = "another press"
"""A capture predicted by other captures of its cell, averaged: how well one press predicts another."""
LAMBDAS = {"ccd-bsm-lambda-1": 1.0, "ccd-bsm-lambda-pi/2": 0.5 * math.pi}
"""Values compared in addition to lambda = pi, which is CCD-BSM itself: the paper's figure 3."""
ORDER = (
    *("ccd-bsmg", "ccd-bsm", FITTED, FITTED_HELD_OUT, "bezier", BEZIER_REFITTED),
    *("ellipse", "line", "circle"),
)
"""Of the paper's tables, calibrated next to uncalibrated."""


@dataclass(frozen=True, slots=True)
class FittedSession(OpenSession):
    """An open session and the brush fit that it uses."""

    fit: BrushFit | None

    @classmethod
    def of(cls, session: OpenSession, fit: BrushFit | None) -> FittedSession:
        """The session with that fit."""
        return cls(session.recording, session.sha256, session.strokes, session.calibration, session.store, fit)


class ModelInfo(Frozen):
    """What a report says of a model, or of what its rows are compared with."""

    name: str
    label: str
    definition: str
    basis: str
    """What it knows of these presses: `as published`, `fitted, in sample`, `fitted, held-out cells`, ..."""
    sha256: str = ""
    """Hash of a generator's file."""


KINDS_OF_PRESS = (
    ModelInfo(
        name=ANOTHER,
        label="another press",
        definition="A capture predicted by other captures of its cell, averaged: how well the brush repeats a press. A "
        "model can do better, because only one of two presses strays from its image.",
        basis=PRESSES,
    ),
    ModelInfo(
        name=CEILING,
        label=CEILING,
        definition="The score of a perfect model, which draws the best image of each cell: estimated from the "
        "similarity of other presses of the cell.",
        basis=PRESSES,
    ),
)
"""What stands in the tables beside the models."""
BEZIER_LEFT_OUT = ModelInfo(
    name=BEZIER_REFITTED,
    label="Bezier refitted",
    definition="Two mirrored cubic Bezier curves; ends, belly and shoulder regressed on the captures of all other "
    "cells.",
    basis=HELD_OUT,
)
BRUSH_LEFT_OUT = ModelInfo(
    name=FITTED_HELD_OUT,
    label="CCD-BSM calibrated",
    definition="CCD-BSM's lengths with gains, powers, profile and edges fitted to the captures of all other cells.",
    basis=HELD_OUT,
)


Mark = tuple[Outline, float]
"""The outline of a press, and the distance of its origin from the zero-touch point, mm."""


@dataclass(frozen=True, slots=True)
class Model:
    """A model to compare with the presses of one session: one row of the tables."""

    info: ModelInfo
    mark: Callable[[Condition], Mark]
    """What it predicts for a condition; raises `DomainError` for a press that it does not predict."""

    @property
    def name(self) -> str:
        """Its name."""
        return self.info.name


def predicted(models: Iterable[Model], at: Condition, store: Store) -> tuple[dict[str, Pixels], dict[str, str]]:
    """(len(KEYS), 128, 128) of a condition by model, and why there is none by model that does not predict it.

    Marks that were drawn before are in the store.
    """
    marks: dict[str, Mark] = {}
    refused: dict[str, str] = {}
    for model in models:
        try:
            marks[model.name] = model.mark(at)
        except DomainError as error:
            refused[model.name] = f"{model.name} does not predict it: {error}"
    parts = ((mark.points, mark.weights, origin_x_mm) for mark, origin_x_mm in marks.values())
    key = key_of("drawn", *itertools.chain.from_iterable(parts))
    drawn = store.get(key)
    if drawn is None:
        drawn = {str(k): images_of(*mark) for k, mark in enumerate(marks.values())}
        store.put(key, drawn)
    return dict(zip(marks, (drawn[str(k)] for k in range(len(marks))), strict=True)), refused


def in_order(models: Sequence[Model]) -> list[Model]:
    """Sort in the order of the paper's tables, all others last."""
    return sorted(models, key=lambda model: ORDER.index(model.name) if model.name in ORDER else len(ORDER))


def known_models(session: FittedSession, generators: Sequence[Path], *, ablations: bool) -> list[Model]:
    """The models that need no held-out fit: generators, the registered models of the brush, and its fit.

    Raises what `load_generator` does, and `CalibrationError` for two generators of one name.
    """
    from brushloop.model.fitted import fitted_model
    from brushloop.model.generator.stroke import load_generator
    from brushloop.model.strokes import stroke_model, stroke_models

    brush, fit = brush_of(session.header), session.fit
    models = [_of_model(model, PUBLISHED) for model in stroke_models(brush).values()]
    if fit is not None:
        basis = "fitted, in sample" if fit.recording_sha256 == session.sha256 else f"fitted on {fit.session_id}"
        models.append(_of_model(fitted_model(fit.press(), "CCD-BSM fitted"), basis))
    for name, lam in LAMBDAS.items() if ablations else ():
        label = f"CCD-BSM, λ = {name.rpartition('-')[2].replace('pi', 'π')}"
        models.append(_of_model(stroke_model("ccd-bsm", brush, lam), PUBLISHED, name=name, label=label))
    for file in generators:
        model = load_generator(file, brush)
        if model.name in [known.name for known in models]:
            raise CalibrationError(str(file), f"is a second {model.name}")
        basis = f"trained on exact images of {model.target.stroke_model.label}"
        basis += ", then tuned on captures" if model.fitted else ""
        models.append(_of_model(model, basis, sha256=file_sha256(file)))
    return in_order(models)


def held_out(info: ModelInfo, outlines: Mapping[Cell, Draw | None]) -> Model:
    """A model that was fitted without the cell that it predicts; None where the other cells are too few."""

    def mark(at: Condition) -> Mark:
        outline = outlines.get((at.depth_mm, at.tilt_deg))
        if outline is None:
            raise DomainError("depth_mm", at.depth_mm, "other cells", "the other cells do not determine this press")
        return outline(at.depth_mm, at.tilt_deg), 0.0

    return Model(info, mark)


def _of_model(model: StrokeModel, basis: str, **changes: str) -> Model:
    info = ModelInfo(name=model.name, label=model.label, definition=model.definition, basis=basis)
    return Model(info.model_copy(update=changes), lambda at: _pressed(model, at))


def _pressed(model: StrokeModel, at: Condition) -> Mark:
    return model.profile(at.depth_mm, at.tilt_deg), at.depth_mm * math.tan(math.radians(at.tilt_deg))
