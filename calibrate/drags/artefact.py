"""The fitted drag model on disk, with everything that is needed to predict the strokes of another session.

The training strokes are kept as packed bits, from which a kernel ridge predicts. Files come from elsewhere: sizes are
checked before anything is unpacked.
"""

from __future__ import annotations

import base64
import binascii
import zlib
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from brushloop.calibrate.artefact import FittedValue, Frozen, SessionFit
from brushloop.calibrate.drags.captures import COMMANDS, commanded_path
from brushloop.calibrate.drags.fit import INK_ABOVE, RIDGE, Residual, captured_distance
from brushloop.model.drag import DragModel, distances, trails

Floats = NDArray[np.float64]

MOST_STROKES = 200
MOST_PIXELS = 400_000
"""Largest number of pixels of one stroke's image."""
MOST_BYTES = 400_000
"""Largest size of the packed images in base64."""
MOST_UNPACKED = 100_000_000
Number = Annotated[float, Field(ge=-1e6, le=1e6)]


class Kept(Frozen):
    """Commands and ink of the training strokes, and the model that they correct.

    The images have square pixels, rows from the top.
    """

    commands: Annotated[list[list[Number]], Field(min_length=1, max_length=MOST_STROKES)]
    """`calibrate.drags.captures.COMMANDS` of each stroke."""
    parameters: Annotated[list[Number], Field(min_length=14, max_length=14)]
    mm_per_px: Annotated[float, Field(ge=0.05, le=5.0)]
    left_mm: Number
    """Centre of the first column; the stroke starts at x = 0."""
    top_mm: Number
    """Centre of the first row, y upward."""
    columns: Annotated[int, Field(ge=8, le=4000)]
    rows: Annotated[int, Field(ge=8, le=4000)]
    ridge: Annotated[float, Field(gt=1e-6, le=1e6)]
    ink: Annotated[str, Field(max_length=MOST_BYTES)]
    """Bits of all images, row by row from the top, compressed with zlib, in base64."""

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.columns * self.rows > MOST_PIXELS or self._size() > MOST_UNPACKED // 8:
            raise ValueError("its images are larger than any grid that is fitted")
        if any(len(row) != len(COMMANDS) for row in self.commands):
            raise ValueError(f"a command is {', '.join(COMMANDS)}")
        return self

    @staticmethod
    def of(
        commands: Floats,
        ink: NDArray[np.bool_],
        x_mm: Floats,
        y_mm: Floats,
        model: DragModel,
    ) -> Kept | None:
        """The strokes as they go into an artefact; None if they do not fit into one, however few are kept."""
        step = max(1, -(-len(commands) // MOST_STROKES))
        mm_per_px = float(x_mm[1] - x_mm[0])
        if ink[0].size > MOST_PIXELS:
            return None
        while len(commands[::step]) > 1:
            packed = zlib.compress(np.packbits(ink[::step]).tobytes(), 9)
            if 4 * (len(packed) // 3 + 1) <= MOST_BYTES:
                return Kept(
                    commands=np.round(commands[::step], 6).tolist(),
                    parameters=[float(v) for v in model.vector()],
                    mm_per_px=round(mm_per_px, 9),
                    left_mm=round(float(x_mm[0]), 6),
                    top_mm=round(float(y_mm[0]), 6),
                    columns=len(x_mm),
                    rows=len(y_mm),
                    ridge=RIDGE,
                    ink=base64.b64encode(packed).decode(),
                )
            step += 1
        return None

    def residual(self) -> tuple[Residual, DragModel]:
        """The ridges, fitted again, and the model that they correct. Raises ValueError for ink that cannot be read."""
        model = DragModel.of(np.array(self.parameters))
        base = self.base(model, [commanded_path(*row[:4]) for row in self.commands])
        captured = captured_distance(self._unpacked(), self.mm_per_px)
        return Residual.fit(np.array(self.commands), base, captured, self.ridge), model

    def base(self, model: DragModel, paths: list[Floats]) -> Floats:
        """Signed distances of a model's marks on the grid of the kept strokes."""
        x_mm = np.asarray(self.left_mm + np.arange(self.columns) * self.mm_per_px, np.float64)
        y_mm = np.asarray(self.top_mm - np.arange(self.rows) * self.mm_per_px, np.float64)
        nodes, starts = trails(paths, model.vector())
        return distances(nodes, starts, x_mm, y_mm)

    def placed(self, change_mm: Floats, x_mm: Floats, y_mm: Floats) -> Floats:
        """Changes of distance (B, rows, columns) on another grid of the same scale; 0 outside."""
        left = round((float(x_mm[0]) - self.left_mm) / self.mm_per_px)
        top = round((self.top_mm - float(y_mm[0])) / self.mm_per_px)
        out = np.zeros((len(change_mm), len(y_mm), len(x_mm)))
        rows = slice(max(0, -top), min(len(y_mm), self.rows - top))
        columns = slice(max(0, -left), min(len(x_mm), self.columns - left))
        if rows.start < rows.stop and columns.start < columns.stop:
            out[:, rows, columns] = change_mm[
                :, rows.start + top : rows.stop + top, columns.start + left : columns.stop + left
            ]
        return out

    def _size(self) -> int:
        return -(-len(self.commands) * self.rows * self.columns // 8)

    def _unpacked(self) -> NDArray[np.bool_]:
        size = self._size()
        try:
            unpack = zlib.decompressobj()
            data = unpack.decompress(base64.b64decode(self.ink, validate=True), size)
        except (zlib.error, binascii.Error) as error:
            raise ValueError(f"ink cannot be unpacked ({error})") from None
        if len(data) != size or unpack.unconsumed_tail:
            raise ValueError(f"ink of {len(data)} bytes, {size} expected")
        shape = (len(self.commands), self.rows, self.columns)
        bits = np.unpackbits(np.frombuffer(data, np.uint8), count=int(np.prod(shape)))
        return bits.reshape(shape).astype(np.bool_)


class DragScore(Frozen):
    """Score of one model on images that it was not fitted to, ink as 0 or 1, at the commanded place."""

    csim_percent: float
    iou_percent: float
    images: int


class Stamps(Frozen):
    """Circle stamps fitted to the same strokes: what a report shows beside the lag."""

    parameters: Annotated[list[float], Field(min_length=14, max_length=14)]
    spread_mm: Annotated[float, Field(gt=0.0, le=50.0)]
    ink_above: Annotated[float, Field(gt=0.0, lt=1.0)]


class DragArtefact(SessionFit):
    """The fitted drag model on disk. Equal inputs give an equal file."""

    schema_version: Literal[1, 2] = 2
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
    """Training strokes, from which the correction of the lag is computed; None for figures."""
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
