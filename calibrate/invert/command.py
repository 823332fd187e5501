"""`brushloop invert SESSION` as a function: depth and tilt of every captured press, and the protocol that repeats them.

Importing this module loads torch.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from html import escape
from pathlib import Path

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.calibrate.fit.artefact import BrushFit
from brushloop.calibrate.invert.invert import (
    NO_MODEL_ERROR,
    NOT_INFORMATIVE,
    Inversion,
    Row,
    Settings,
    invert_recording,
    off_command,
)
from brushloop.model.fitted import NAMES
from brushloop.model.fitted_shape import fitted_model
from brushloop.model.inversion.press import Range
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

    inversion: Inversion
    out: Path
    protocol: Path

    @property
    def rows(self) -> list[Row]:
        """One row for each recovered press."""
        return self.inversion.rows

    def lines(self) -> Iterator[str]:
        """What the command prints."""
        found = self.inversion
        many, source = len(found.rows), found.header.source
        yield f"{found.header.session_id}: {many} presses recovered by {found.settings.model} ({source})"
        for name, mean, sd, inside, n in off_command(found.rows):
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
        for stroke_id, why in found.refused:
            yield f"not used: {stroke_id}: {why}"
        yield str(self.out)
        yield str(self.protocol)

    def _flagged(self, flag: str) -> int:
        return sum(flag in row.flags for row in self.rows)

    def _repr_html_(self) -> str:
        rows = (COLUMNS, *csv_rows(self.inversion))
        cells = ("".join(f"<td>{escape(str(value))}</td>" for value in row) for row in rows)
        return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def recover(request: RecoverRequest, progress: Progress = unseen) -> Recovered:
    """Recover every press of a session; write the CSV and the protocol. Raises `CalibrationError`."""
    settings = _settings(request)
    found = invert_recording(request.session, settings, request.calibration, request.presses, progress)
    return Recovered(found, request.out, write_inversion(found, request.out, request.repeats, request.seed))


def _settings(request: RecoverRequest) -> Settings:
    try:
        within = Range(request.depth_range_mm, request.tilt_range_deg)
        if within.tilt_deg[1] > 30:
            raise ValueError(f"tilt_deg = {within.tilt_deg}: expected 0 to 30")
    except ValueError as error:
        raise CalibrationError("--depth-range, --tilt-range", str(error)) from None
    view = Field(mm_per_px=request.mm_per_px)
    if request.fit is None:
        return Settings(request.model, None, frozenset(), request.lam, within, request.anchor_sd_mm, view)
    artefact = load_artefact(request.fit, BrushFit)
    press = artefact.press()
    # A fitted brush marks nothing above its zero offset.
    least = max(within.depth_mm[0], 0.5 - float(press.values[NAMES.index("h0_mm")]))
    if least >= within.depth_mm[1]:
        raise CalibrationError("--depth-range", f"ends before the fitted brush marks, at {least:.2f} mm")
    within, model = Range((least, within.depth_mm[1]), within.tilt_deg), fitted_model(press)
    return Settings(model.name, model, frozenset(artefact.cells), request.lam, within, request.anchor_sd_mm, view)


def write_inversion(made: Inversion, out: Path, repeats: int = 1, seed: int = 1) -> Path:
    """Write `out` and the protocol beside it, which presses each stroke `repeats` times in an order drawn with `seed`.

    Returns the protocol's path. Raises `CalibrationError` and OSError.
    """
    if not made.rows:
        why = f": {made.refused[0][0]}: {made.refused[0][1]}" if made.refused else ""
        raise CalibrationError(str(made.recording), f"no stroke could be recovered{why}")
    if len(made.rows) * repeats > MAX_ROWS:
        problem = f"{len(made.rows) * repeats} strokes with repeats, a protocol holds at most {MAX_ROWS}"
        raise CalibrationError(str(made.recording), problem)
    if out.name == PROTOCOL or not out.name.isprintable() or "\\" in out.name or len(out.name) > 200:
        raise CalibrationError(str(out), "a protocol cannot name this file: give a plain name, as recovered.csv")
    out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(out, csv_text(COLUMNS, csv_rows(made)))
    protocol = out.parent / PROTOCOL
    write_whole(protocol, replay_toml(made, out.name, repeats, seed))
    return protocol


def csv_rows(made: Inversion) -> Iterator[list[str]]:
    """One row per stroke; depths and tilts to three decimals, deviations to three figures."""
    for row in made.rows:
        asked = ["" if v is None else f"{v:g}" for v in (row.commanded_depth_mm, row.commanded_tilt_deg)]
        numbers = [f"{row.depth_mm:.3f}", f"{row.tilt_deg:.3f}", f"{row.depth_sd_mm:.3g}", f"{row.tilt_sd_deg:.3g}"]
        yield [row.stroke_id, *numbers, f"{row.rms:.4f}", " ".join(row.flags), *asked, str(made.header.source)]


def replay_toml(made: Inversion, name: str, repeats: int = 1, seed: int = 1) -> str:
    """The `replay` protocol for the CSV file `name`."""
    return (
        f"# Recovered by {made.settings.model} from {made.header.session_id} ({made.header.source}), "
        f"recording sha256 {made.recording_sha256}.\n"
        'kind = "replay"\n'
        f"of = {json.dumps(made.header.session_id, ensure_ascii=False)}\n"
        f"file = {json.dumps(name, ensure_ascii=False)}\n"
        f"repeats = {repeats}\n"
        f"seed = {seed}\n"
    )
