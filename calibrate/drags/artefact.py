"""The fitted drag model on disk, with everything that is needed to predict the strokes of another session."""

from __future__ import annotations

from typing import Annotated, ClassVar, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from calibrate.artefact import FittedValue, SessionFit
from calibrate.drags.fit import INK_ABOVE
from calibrate.drags.kept import Kept
from model.drag import DragModel

SCHEMA_VERSION = 2


class DragScore(BaseModel):
    """Score of one model on images that it was not fitted to, ink as 0 or 1, at the commanded place."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    csim_percent: float
    iou_percent: float
    images: int


class Stamps(BaseModel):
    """Circle stamps fitted to the same strokes: what a report shows beside the lag."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    parameters: Annotated[list[float], Field(min_length=14, max_length=14)]
    spread_mm: Annotated[float, Field(gt=0.0, le=50.0)]
    ink_above: Annotated[float, Field(gt=0.0, lt=1.0)]


class DragArtefact(SessionFit):
    """The fitted drag model on disk. Equal inputs give an equal file."""

    versions: ClassVar[tuple[int, ...]] = (1, SCHEMA_VERSION)

    schema_version: int = SCHEMA_VERSION
    images: int
    strokes: int
    mm_per_px: float
    spread_mm: float
    """Variation of an edge from stroke to stroke (scale of the logistic)."""
    parameters: dict[str, FittedValue]
    condition: float
    """Condition number of the scaled normal equations: above about 1e4 the parameters cannot be distinguished."""
    held_out: dict[str, DragScore]
    """Scores by model; empty with too few images to leave any out."""
    ink_above: Annotated[float, Field(gt=0.0, lt=1.0)] = INK_ABOVE
    """A pixel counts as ink above this probability: chosen on the training strokes."""
    stamps: Stamps | None = None
    kept: Kept | None = None
    """Training strokes, from which the correction of the lag is computed; None for figures, and before version 2."""
    fitted_strokes: tuple[str, ...] = ()
    """The strokes that were fitted, which must not be scored as held out."""
    prior: str = ""
    """Digest of the fit whose brush was adapted to this session; empty for a fit of its own."""
    prior_session: str = ""
    refitted: tuple[str, ...] = ()
    """The parameters that were adapted."""

    def model(self) -> DragModel:
        """The fitted drag model."""
        return DragModel(**{name: value.value for name, value in self.parameters.items()})

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if set(self.parameters) != set(DragModel.names()):
            raise ValueError(f"parameters: expected {', '.join(DragModel.names())}")
        return self
