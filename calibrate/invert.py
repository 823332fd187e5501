"""`brushloop invert SESSION`: depth and tilt of every captured press, and the protocol that presses them again.

Each press is recovered from its coverage of the millimetre field, with its interval. The recovered (H, alpha) is the
press for which this model makes this mark. It measures the actual press only as well as the model describes the brush:
where commands are known, the model's error is told from them and added.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brushloop.calibrate.artefact import load_artefact
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.place import Field, brush_of
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import write_whole
from brushloop.calibrate.fit.brush import BrushFit
from brushloop.calibrate.presses import Press, Refused, cut, read_presses
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stats import student_95
from brushloop.model.ccdbsm import Brush, DomainError
from brushloop.model.fitted import NAMES, fitted_model
from brushloop.model.inversion import Flag, Inverter, Range
from brushloop.model.strokes import UnknownModelError, stroke_model
from brushloop.sessions.disk import csv_text
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, unseen

PROTOCOL = "protocol-replay.toml"
MAX_ROWS = 10_000
COLUMNS = (
    "stroke_id", "depth_mm", "tilt_deg", "depth_sd_mm", "tilt_sd_deg", "rms", "flags",
    "commanded_depth_mm", "commanded_tilt_deg", "source",
)  # fmt: skip
NO_MODEL_ERROR = "no_model_error"
"""Flag of a press whose standard deviations leave out the error of the model."""
NOT_INFORMATIVE = {"H": "depth_not_informative", "alpha": "tilt_not_informative"}
"""Flags of a value whose 95 % interval covers most of the range that was commanded in the session."""
MOST = 0.8
"""Share of that range from which on an interval is not informative."""
BATCH = 64
USELESS = frozenset({Flag.BLANK, Flag.DID_NOT_CONVERGE, Flag.CUT})
"""Flags that exclude a stroke: it is listed with the reason and not pressed again."""
Floats = NDArray[np.float64]
LEAST_CONDITIONS = 3
"""With fewer other conditions, the model error is unknown."""
NORMAL_95 = 1.96
ROUNDS = 100


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


def _inverter(request: RecoverRequest, brush: Brush) -> tuple[Inverter, str, Collection[Condition]]:
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
            fitted = {Condition(*cell) for cell in artefact.cells}
        else:
            model, fitted = (
                stroke_model(request.model, brush, math.pi if request.lam is None else request.lam),
                set[Condition](),
            )
        inverter = Inverter(model, within, px_mm=request.mm_per_px, anchor_sigma_mm=request.anchor_sd_mm)
        return inverter, model.name, fitted
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


@dataclass(frozen=True, slots=True)
class Row:
    """One recovered stroke."""

    stroke_id: str
    depth_mm: float
    tilt_deg: float
    depth_sd_mm: float
    tilt_sd_deg: float
    rms: float
    flags: tuple[str, ...]
    commanded_depth_mm: float | None
    commanded_tilt_deg: float | None


def invert_presses(presses: Iterable[Press], inverter: Inverter, refused: list[Refused]) -> list[Row]:
    """Recover presses in batches, by the image alone; those that cannot be recovered go to `refused`."""
    rows: dict[str, Row] = {}
    remaining = iter(presses)
    while batch := list(islice(remaining, BATCH)):
        images = np.stack([press.coverage for press in batch])
        places = np.array([press.anchor_mm for press in batch])
        recovered = inverter(images, places, np.array([press.stroke.heading_deg for press in batch]))
        for k, press in enumerate(batch):
            stroke, flags = press.stroke, recovered.flags[k]
            useless = ", ".join(sorted(flags & USELESS))
            if problem := useless or _unnameable(stroke.stroke_id, rows):
                refused.append((stroke.stroke_id, problem))
                continue
            (depth_mm, tilt_deg), (depth_sd_mm, tilt_sd_deg) = recovered.values[k, :2], recovered.sigma[k, :2]
            rows[stroke.stroke_id] = Row(
                stroke.stroke_id,
                float(depth_mm),
                float(tilt_deg),
                float(depth_sd_mm),
                float(tilt_sd_deg),
                float(recovered.rms[k]),
                tuple(sorted(flags)),
                stroke.depth_mm,
                stroke.tilt_deg,
            )
    return list(rows.values())


def with_model_error(rows: Sequence[Row], fitted: Collection[Condition] = ()) -> list[Row]:
    """The rows with the model error added to their standard deviations, and flags for unknown or wide intervals.

    `fitted` are the conditions that the model was fitted to.
    """
    nan = float("nan")
    conditions = [Condition(row.commanded_depth_mm or 0.0, row.commanded_tilt_deg or 0.0) for row in rows]
    deep = np.array([nan if (h := row.commanded_depth_mm) is None else row.depth_mm - h for row in rows])
    tilted = np.array([nan if (a := row.commanded_tilt_deg) is None else row.tilt_deg - a for row in rows])
    height_sd = np.array([row.depth_sd_mm for row in rows])
    tilt_sd = np.array([row.tilt_sd_deg for row in rows])
    known = [conditions[k] for k in np.flatnonzero(np.isfinite(deep) & np.isfinite(tilted))]
    more_mm = model_sd(deep, height_sd, conditions, fitted)
    # alpha follows from the distance H tan(alpha), in which the model errs by so many mm whatever the depth. An upright
    # press that was recovered at 0, the end of the range, does not show its error.
    depth = np.array([row.depth_mm for row in rows])
    shown = np.where(tilted == 0.0, nan, tilted)
    more_deg = model_sd(shown * depth, tilt_sd * depth, conditions, fitted) / depth
    out: list[Row] = []
    for k, row in enumerate(rows):
        flags = set(row.flags)
        if np.isnan(more_mm[k]) or np.isnan(more_deg[k]):
            flags.add(NO_MODEL_ERROR)
        else:
            wider = float(np.hypot(row.tilt_sd_deg, more_deg[k]))
            row = replace(row, depth_sd_mm=float(np.hypot(row.depth_sd_mm, more_mm[k])), tilt_sd_deg=wider)
        for name, (value, sd, among) in {
            "H": (row.depth_mm, row.depth_sd_mm, [condition.depth_mm for condition in known]),
            "alpha": (row.tilt_deg, row.tilt_sd_deg, [condition.tilt_deg for condition in known]),
        }.items():
            if covers_most(value, sd, among):
                flags.add(NOT_INFORMATIVE[name])
        out.append(replace(row, flags=tuple(sorted(flags))))
    return out


def covers_most(value: float, sd: float, commanded: Sequence[float]) -> bool:
    """Whether a 95 % interval, cut to the range of the commanded values, covers most of that range."""
    low, high = min(commanded, default=0.0), max(commanded, default=0.0)
    covered = min(value + NORMAL_95 * sd, high) - max(value - NORMAL_95 * sd, low)
    return high > low and covered > MOST * (high - low)


def _unnameable(ident: str, taken: Collection[str]) -> str:
    """Reason why a protocol cannot press a stroke of this name again; empty if it can."""
    if ident in taken:
        return "its name is that of another stroke too"
    if not 1 <= len(ident) <= 100 or not ident.isprintable() or any(c in ' /\\<>:"|?*' for c in ident):
        return "its name cannot stand in a protocol"
    return "its name cannot stand in a protocol" if ident[0] in ".-~" else ""


def off_command(rows: list[Row]) -> Iterator[tuple[str, float, float | None, float, int]]:
    """Yield (parameter, mean of recovered - commanded, standard deviation, share in the 95 % interval, n).

    A single press has no standard deviation: None.
    """
    pairs = {
        "H": [(r.depth_mm, r.depth_sd_mm, r.commanded_depth_mm) for r in rows],
        "alpha": [(r.tilt_deg, r.tilt_sd_deg, r.commanded_tilt_deg) for r in rows],
    }
    for name, values in pairs.items():
        known = [(value - asked, sd) for value, sd, asked in values if asked is not None]
        if known:
            off, sd = (np.array(part, np.float64) for part in zip(*known, strict=True))
            inside = np.abs(off) <= NORMAL_95 * sd
            scatter = float(off.std(ddof=1)) if len(off) > 1 else None
            yield name, float(off.mean()), scatter, float(inside.mean()), len(off)


def model_sd(off: Floats, sd: Floats, conditions: Sequence[Condition], fitted: Collection[Condition] = ()) -> Floats:
    """Standard deviation of the model error of N presses, (N,); NaN where too few other conditions are known.

    `off` (N,) is recovered - commanded, NaN where no command is known; `sd` (N,) is the standard deviation from the
    image alone. `fitted` are the conditions that the brush was fitted to. The result is enlarged by Student's t with a
    degree of freedom for each condition, so that 1.96 times it covers 95 % with few of them.
    """
    out = np.full(len(off), np.nan)
    known = np.isfinite(off) & np.isfinite(sd)
    for condition in set(conditions):
        others = [k for k, other in enumerate(conditions) if other != condition and known[k]]
        unseen = [] if condition in fitted else [k for k in others if conditions[k] not in fitted]
        spreads = [_spread(off[k], sd[k], len({conditions[at] for at in k})) for k in (others, unseen) if k]
        if len({conditions[k] for k in others}) >= LEAST_CONDITIONS:
            out[[k for k, other in enumerate(conditions) if other == condition]] = max(spreads)
    return out


def common_variance(off: Floats, sd: Floats) -> float:
    """The variance v for which the mean of off^2 / (sd^2 + v) is 1; 0 where the deviations `sd` alone explain `off`.

    A press that its image hardly determines counts little, however large its deviation.
    """
    variance = 0.0
    square = np.maximum(sd**2, 1e-12)
    for _ in range(ROUNDS):  # Newton's method, which approaches the root of a convex function from below
        weight = 1.0 / (square + variance)
        excess = float(np.mean(off**2 * weight)) - 1.0
        if excess < 1e-9:
            break
        variance += excess / float(np.mean((off * weight) ** 2))
    return variance


def _spread(off: Floats, sd: Floats, conditions: int) -> float:
    """The deviation from presses of so many conditions, enlarged; 0 from too few."""
    if conditions < LEAST_CONDITIONS:
        return 0.0
    return math.sqrt(common_variance(off, sd)) * student_95(conditions) / NORMAL_95
