"""`brushloop invert SESSION` as a function: depth and tilt of each press, and the protocol that repeats them."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.invert.invert import (
    NO_MODEL_ERROR,
    NOT_INFORMATIVE,
    DepthTilt,
    Row,
    invert_presses,
    off_command,
    with_model_error,
)
from brushloop.calibrate.presses import Refused, cut, read_presses
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.fitted import NAMES, fitted_model
from brushloop.model.inversion import Inverter, Range
from brushloop.model.strokes import UnknownModelError, stroke_model
from brushloop.sessions.disk import csv_text
from brushloop.sessions.terminal import Progress, unseen

PROTOCOL = "protocol-replay.toml"
MAX_ROWS = 10_000
COLUMNS = (
    "stroke_id", "depth_mm", "tilt_deg", "depth_sd_mm", "tilt_sd_deg", "rms", "flags",
    "commanded_depth_mm", "commanded_tilt_deg", "source",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RecoverRequest:
    """Whose presses are recovered, and how."""

    session: Path
    out: Path
    """CSV to write; the protocol goes beside it."""
    model: str = "ccd-bsm"
    fit: Path | None = None
    """A brush fitted to captures, instead of the model."""
    lam: float | None = None
    """lambda of CCD-BSM; None is pi."""
    depth_range_mm: tuple[float, float] = (2.0, 30.0)
    tilt_range_deg: tuple[float, float] = (0.0, 30.0)
    anchor_sd_mm: float = 0.1
    """Standard deviation of the zero-touch point."""
    mm_per_px: float = MM_PER_PX
    calibration: Path | None = None
    """Artefact; None is the one in use."""
    presses: int | None = None
    """Only this many, spread evenly over the session."""
    repeats: int = 1
    """How often the protocol presses each stroke."""
    seed: int = 1
    """Seed of the order in which it does."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """The recovered presses and the files that hold them."""

    session: OpenSession
    model: str
    rows: list[Row]
    """One for each recovered press."""
    refused: list[Refused]
    """(stroke, reason) of each press that was not recovered."""
    out: Path

    @property
    def protocol(self) -> Path:
        """The protocol that presses them again, beside the CSV."""
        return self.out.parent / PROTOCOL

    def csv_rows(self) -> Iterator[list[str]]:
        """One row per stroke; depths and tilts to three decimals, deviations to three figures."""
        for row in self.rows:
            asked = ["" if v is None else f"{v:g}" for v in (row.commanded_depth_mm, row.commanded_tilt_deg)]
            numbers = [f"{row.depth_mm:.3f}", f"{row.tilt_deg:.3f}", f"{row.depth_sd_mm:.3g}", f"{row.tilt_sd_deg:.3g}"]
            source = str(self.session.header.source)
            yield [row.stroke_id, *numbers, f"{row.rms:.4f}", " ".join(row.flags), *asked, source]

    def lines(self) -> Iterator[str]:
        """What the command prints."""
        many, header = len(self.rows), self.session.header
        yield f"{header.session_id}: {many} presses recovered by {self.model} ({header.source})"
        for name, mean, sd, inside, n in off_command(self.rows):
            unit = "mm" if name == "H" else "deg"
            scatter = "" if sd is None else f", sd {sd:.3f}"
            yield f"{name}: recovered - commanded {mean:+.3f} {unit}{scatter}; {inside:.0%} of {n} in the interval"
        yield (
            "alpha follows from how far the mark lies from the zero-touch point, and is as accurate as the model's "
            "prediction of that distance; the shape of the mark alone does not determine it."
        )
        if bare := self._flagged(NO_MODEL_ERROR):
            yield f"warning: {bare} without model error in their intervals: too few cells with a known command"
        for name, flag in NOT_INFORMATIVE.items():
            if vague := self._flagged(flag):
                yield f"warning: {vague} not informative on {name}: the interval covers most of the commanded range"
        bound = self._flagged("at_bound")
        if 2 * bound > many:
            yield f"warning: {bound} at a bound: the model does not fit this brush; do not press these again"
        elif bound:
            yield f"warning: {bound} at a bound of the range: their intervals are valid on one side at most"
        for stroke_id, why in self.refused:
            yield f"not used: {stroke_id}: {why}"
        yield str(self.out)
        yield str(self.protocol)

    def _flagged(self, flag: str) -> int:
        return sum(flag in row.flags for row in self.rows)

    def _repr_html_(self) -> str:
        rows = (COLUMNS, *self.csv_rows())
        cells = ("".join(f"<td>{escape(str(value))}</td>" for value in row) for row in rows)
        return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def recover(request: RecoverRequest, progress: Progress = unseen) -> Recovered:
    """Recover every press of a session, or some of them spread evenly over it; write the CSV and the protocol.

    Raises `CalibrationError` and OSError.
    """
    out = request.out
    if out.name == PROTOCOL or not out.name.isprintable() or "\\" in out.name or len(out.name) > 200:
        raise CalibrationError(str(out), "a protocol cannot name this file: give a plain name, as recovered.csv")
    session = open_session(request.session, request.calibration, "press")
    inverter, model, fitted = _inverter(request, brush_of(session.header))
    count, refused = len(session.strokes), list[Refused]()
    most = min(count, request.presses or count)
    chosen = {session.strokes[number * count // most].stroke_id for number in range(most)}
    view = Field(mm_per_px=request.mm_per_px)
    presses = read_presses(session, view, refused, cut, chosen=chosen, progress=progress)
    rows = with_model_error(invert_presses(presses, inverter, refused), fitted)
    recovered = Recovered(session, model, rows, refused, out)
    _write(recovered, request.repeats, request.seed)
    return recovered


def _inverter(request: RecoverRequest, brush: Brush) -> tuple[Inverter, str, Collection[DepthTilt]]:
    """The inverter, its model's name, and the conditions that the model was fitted to, as far as they are known."""
    try:
        within = Range(request.depth_range_mm, request.tilt_range_deg)
        if within.tilt_deg[1] > 30:
            raise ValueError(f"tilt_deg = {within.tilt_deg}: expected 0 to 30")
    except ValueError as error:
        raise CalibrationError("--depth-range, --tilt-range", str(error)) from None
    try:
        if request.fit is not None:
            artefact = load_artefact(request.fit, BrushFit)
            press = artefact.press()
            # A fitted brush marks nothing above its zero offset.
            least = max(within.depth_mm[0], 0.5 - float(press.values[NAMES.index("h0_mm")]))
            if least >= within.depth_mm[1]:
                raise CalibrationError("--depth-range", f"ends before the fitted brush marks, at {least:.2f} mm")
            model, within = fitted_model(press), Range((least, within.depth_mm[1]), within.tilt_deg)
            cells: Collection[DepthTilt] = artefact.cells
        else:
            model, cells = stroke_model(request.model, brush, math.pi if request.lam is None else request.lam), ()
        inverter = Inverter(model, within, px_mm=request.mm_per_px, anchor_sigma_mm=request.anchor_sd_mm)
        return inverter, model.name, cells
    except UnknownModelError as error:
        raise CalibrationError("--model", str(error)) from None
    except DomainError as error:
        raise CalibrationError("--depth-range, --tilt-range", str(error)) from None


def _write(recovered: Recovered, repeats: int, seed: int) -> None:
    """Write the CSV and the protocol, which presses each stroke `repeats` times in an order drawn with `seed`.

    Raises `CalibrationError` and OSError.
    """
    where, refused = str(recovered.session.recording.path), recovered.refused
    if not recovered.rows:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        raise CalibrationError(where, f"no stroke could be recovered{why}")
    count = len(recovered.rows) * repeats
    if count > MAX_ROWS:
        raise CalibrationError(where, f"{count} strokes with repeats, a protocol holds at most {MAX_ROWS}")
    recovered.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(recovered.out, csv_text(COLUMNS, recovered.csv_rows()))
    header = recovered.session.header
    write_whole(
        recovered.protocol,
        f"# Recovered by {recovered.model} from {header.session_id} ({header.source}), "
        f"recording sha256 {recovered.session.sha256}.\n"
        'kind = "replay"\n'
        f"of = {json.dumps(header.session_id, ensure_ascii=False)}\n"
        f"file = {json.dumps(recovered.out.name, ensure_ascii=False)}\n"
        f"repeats = {repeats}\n"
        f"seed = {seed}\n",
    )
