"""`brushloop recover SESSION`: depth and tilt of every captured press, and the protocol that presses them again.

Each press is recovered from its coverage of the millimetre field, with its interval. The recovered (H, alpha) is the
press for which this brush makes this mark. It measures the actual press only as well as the model describes the brush:
the error of the model is estimated from the commanded values of other conditions, and widens each interval.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np

from brushloop.calibrate.commands import RecoverRequest
from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.files import check_target, write_whole
from brushloop.calibrate.fit.command import BrushFit
from brushloop.calibrate.presses import Press, Refused, beside_touch, cut, read_presses
from brushloop.calibrate.session import OpenSession, open_session
from brushloop.calibrate.stats import NORMAL_95, Floats, student_95
from brushloop.model.inversion import Flag, Inverter, Range
from brushloop.sessions.disk import csv_text
from brushloop.sessions.records import Condition
from brushloop.sessions.terminal import Progress, plain, unseen

PROTOCOL = "protocol-replay.toml"
COLUMNS = (
    "stroke_id", "depth_mm", "tilt_deg", "depth_sd_mm", "tilt_sd_deg", "rms", "flags",
    "commanded_depth_mm", "commanded_tilt_deg", "source",
)  # fmt: skip
ANCHOR_SD_MM = 0.1
"""Standard deviation of the zero-touch point."""
NO_MODEL_ERROR = "no_model_error"
"""Flag of a press whose standard deviations leave out the error of the model."""
NOT_INFORMATIVE = {"H": "depth_not_informative", "alpha": "tilt_not_informative"}
"""Flags of a value whose 95 % interval covers most of the range that was commanded in the session."""
MOST = 0.8
"""Share of that range from which on an interval is not informative."""
USELESS = frozenset({Flag.BLANK, Flag.DID_NOT_CONVERGE, Flag.CUT})
"""Flags that exclude a stroke: it is listed with the reason and not pressed again."""
LEAST_CONDITIONS = 3
"""With fewer other conditions, the model error is unknown."""


@dataclass(frozen=True, slots=True)
class Row:
    """One recovered stroke."""

    stroke_id: str
    commanded: Condition
    depth_mm: float
    tilt_deg: float
    depth_sd_mm: float
    tilt_sd_deg: float
    rms: float
    flags: frozenset[str] = frozenset()

    @property
    def off(self) -> dict[str, tuple[float, float]]:
        """Recovered less commanded, and the standard deviation, of H in mm and of alpha in deg."""
        return {
            "H": (self.depth_mm - self.commanded.depth_mm, self.depth_sd_mm),
            "alpha": (self.tilt_deg - self.commanded.tilt_deg, self.tilt_sd_deg),
        }


@dataclass(frozen=True, slots=True)
class Recovered:
    """The recovered presses and the files that hold them."""

    session: OpenSession
    model: str
    rows: list[Row]
    left_out: list[Refused]
    out: Path

    @property
    def protocol(self) -> Path:
        """The protocol that presses them again, beside the CSV."""
        return self.out.parent / PROTOCOL

    def csv_rows(self) -> Iterator[list[str]]:
        """One row per stroke; depths and tilts to three decimals, deviations to three figures."""
        source = str(self.session.header.source)
        for row in self.rows:
            numbers = [f"{row.depth_mm:.3f}", f"{row.tilt_deg:.3f}", f"{row.depth_sd_mm:.3g}", f"{row.tilt_sd_deg:.3g}"]
            asked = [f"{row.commanded.depth_mm:g}", f"{row.commanded.tilt_deg:g}"]
            yield [row.stroke_id, *numbers, f"{row.rms:.4f}", " ".join(sorted(row.flags)), *asked, source]

    def lines(self) -> Iterator[str]:
        """What the command prints."""
        many, header = len(self.rows), self.session.header
        yield f"{header.session_id}: {many} presses recovered by {self.model} ({header.source})"
        for name, unit in (("H", "mm"), ("alpha", "deg")):
            off, sd = np.transpose([row.off[name] for row in self.rows])
            scatter = f" ± {off.std(ddof=1):.2f}" if many > 1 else ""
            inside = int((np.abs(off) <= NORMAL_95 * sd).sum())
            yield (
                f"{name}: recovered values are {off.mean():+.2f}{scatter} {unit} from the commanded ones; "
                f"{inside} of {many} intervals (95 %) contain the commanded value"
            )
        flagged = Counter(flag for row in self.rows for flag in row.flags)
        if bare := flagged[NO_MODEL_ERROR]:
            yield (
                f"warning: the intervals of {bare} presses leave out the error of the model: fewer than "
                f"{LEAST_CONDITIONS} other combinations of H and alpha were pressed"
            )
        for name, flag in NOT_INFORMATIVE.items():
            if vague := flagged[flag]:
                yield f"warning: {vague} presses hardly determine {name}: its interval covers most of the range"
        if 2 * (bound := flagged[Flag.AT_BOUND]) > many:
            yield f"warning: {bound} presses lie at a limit of H or alpha: first fit this brush (`brushloop fit`)"
        for stroke_id, why in self.left_out:
            yield f"not used: {stroke_id}: {why}"
        yield str(self.out)
        yield str(self.protocol)

    def _repr_html_(self) -> str:
        rows = (COLUMNS, *self.csv_rows())
        cells = ("".join(f"<td>{escape(str(value))}</td>" for value in row) for row in rows)
        return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def recover(request: RecoverRequest, progress: Progress = unseen) -> Recovered:
    """Recover every press of a session, or some of them spread evenly over it; write the CSV and the protocol.

    Raises `CalibrationError` and OSError.
    """
    check_target(request.out, ".csv")
    session = open_session(request.session, "press")
    inverter, fitted = _inverter(request, session)
    count, refused = len(session.strokes), list[Refused]()
    most = min(count, request.presses or count)
    chosen = {session.strokes[number * count // most].stroke_id for number in range(most)}
    presses = read_presses(session, refused, beside_touch, cut, chosen=chosen, progress=progress)
    rows = [row for press in presses if (row := _row(press, inverter, refused))]
    if not rows:
        why = f": {refused[0][0]}: {refused[0][1]}" if refused else ""
        way_out = "" if fitted else f"; {inverter.model.label} was used: fit this brush first (`brushloop fit`)"
        raise CalibrationError(str(session.recording.path), f"no stroke could be recovered{why}{way_out}")
    recovered = Recovered(session, inverter.model.label, with_model_error(rows, fitted), refused, request.out)
    request.out.parent.mkdir(parents=True, exist_ok=True)
    write_whole(request.out, csv_text(COLUMNS, recovered.csv_rows()))
    write_whole(recovered.protocol, _protocol(recovered, request))
    return recovered


def _protocol(recovered: Recovered, request: RecoverRequest) -> str:
    """The protocol that presses each recovered stroke, in an order drawn with `seed`."""
    header = recovered.session.header
    presses = "".join(
        f"    {{stroke_id = {json.dumps(row.stroke_id, ensure_ascii=False)}, depth_mm = {row.depth_mm:.3f}, "
        f"tilt_deg = {row.tilt_deg:.3f}}},\n"
        for row in recovered.rows
    )
    return (
        f"# Recovered by {plain(recovered.model)} from {header.session_id} ({header.source}), "
        f"recording sha256 {recovered.session.sha256}.\n"
        'kind = "list"\n'
        f"of = {json.dumps(header.session_id, ensure_ascii=False)}\n"
        f"seed = {request.seed}\n"
        f"presses = [\n{presses}]\n"
    )


def _inverter(request: RecoverRequest, session: OpenSession) -> tuple[Inverter, Collection[Condition]]:
    """The inverter, and the conditions that its brush was fitted to."""
    model, fit = BrushFit.model_of(request.fit, session)
    # A fitted brush marks nothing above its zero offset.
    least_mm = 0.0 if fit is None else 0.5 - fit.parameters["h0_mm"]
    fitted = set[Condition]() if fit is None else {Condition(*pair) for pair in fit.cells}
    low_mm, high_mm = request.depth_range_mm
    try:
        within = Range((max(low_mm, least_mm), high_mm), request.tilt_range_deg)
        return Inverter(model, within, px_mm=MM_PER_PX, anchor_sigma_mm=ANCHOR_SD_MM), fitted
    except ValueError as error:
        raise CalibrationError(str(request.session), f"no depth and tilt that this brush can press: {error}") from None


def _row(press: Press, inverter: Inverter, refused: list[Refused]) -> Row | None:
    """A press recovered by its image alone; one that cannot be recovered goes to `refused`."""
    stroke, place = press.stroke, np.array([press.anchor_mm])
    recovered = inverter(press.coverage[None], place, stroke.heading_deg)
    [flags], [rms] = recovered.flags, recovered.rms.tolist()
    if useless := flags & USELESS:
        refused.append((stroke.stroke_id, ", ".join(sorted(useless))))
        return None
    (depth_mm, tilt_deg), (depth_sd_mm, tilt_sd_deg) = recovered.values[0, :2].tolist(), recovered.sigma[0, :2].tolist()
    return Row(stroke.stroke_id, press.condition, depth_mm, tilt_deg, depth_sd_mm, tilt_sd_deg, rms, flags)


def with_model_error(rows: Sequence[Row], fitted: Collection[Condition] = ()) -> list[Row]:
    """The rows with the model error added to their standard deviations, and flags for unknown or wide intervals.

    `fitted` are the conditions that the model was fitted to.
    """
    commanded = [row.commanded for row in rows]
    (deep, deep_sd), (tilted, tilted_sd) = (np.transpose([row.off[name] for row in rows]) for name in ("H", "alpha"))
    more_mm = model_sd(deep, deep_sd, commanded, fitted)
    # alpha follows from the distance H tan(alpha), in which the model errs by so many mm whatever the depth. An upright
    # press that was recovered at 0, the end of the range, does not show its error.
    depth = np.array([row.depth_mm for row in rows])
    shown = np.where(tilted == 0.0, np.nan, tilted)
    more_deg = model_sd(shown * depth, tilted_sd * depth, commanded, fitted) / depth
    out: list[Row] = []
    for row, mm, deg in zip(rows, more_mm.tolist(), more_deg.tolist(), strict=True):
        flags = set(row.flags)
        if math.isnan(mm) or math.isnan(deg):
            flags.add(NO_MODEL_ERROR)
            mm = deg = 0.0
        depth_sd_mm, tilt_sd_deg = math.hypot(row.depth_sd_mm, mm), math.hypot(row.tilt_sd_deg, deg)
        if covers_most(row.depth_mm, depth_sd_mm, [at.depth_mm for at in commanded]):
            flags.add(NOT_INFORMATIVE["H"])
        if covers_most(row.tilt_deg, tilt_sd_deg, [at.tilt_deg for at in commanded]):
            flags.add(NOT_INFORMATIVE["alpha"])
        out.append(replace(row, depth_sd_mm=depth_sd_mm, tilt_sd_deg=tilt_sd_deg, flags=frozenset(flags)))
    return out


def covers_most(value: float, sd: float, commanded: Sequence[float]) -> bool:
    """Whether a 95 % interval, cut to the range of the commanded values, covers most of that range."""
    low, high = min(commanded), max(commanded)
    covered = min(value + NORMAL_95 * sd, high) - max(value - NORMAL_95 * sd, low)
    return high > low and covered > MOST * (high - low)


def model_sd(off: Floats, sd: Floats, conditions: Sequence[Condition], fitted: Collection[Condition] = ()) -> Floats:
    """Standard deviation of the model error of N presses, (N,); NaN where there are too few other conditions.

    `off` (N,) is recovered - commanded, NaN for a press that does not show it; `sd` (N,) is the standard deviation from
    the image alone. `fitted` are the conditions that the brush was fitted to. The result is enlarged by Student's t
    with a degree of freedom for each condition, so that 1.96 times it covers 95 % with few of them.
    """
    out = np.full(len(off), np.nan)
    known = np.isfinite(off) & np.isfinite(sd)
    for condition in set(conditions):
        others = [k for k, other in enumerate(conditions) if other != condition and known[k]]
        unseen = [] if condition in fitted else [k for k in others if conditions[k] not in fitted]
        spreads = list[float]()
        for presses in (others, unseen):
            if (many := len({conditions[k] for k in presses})) >= LEAST_CONDITIONS:
                spreads.append(math.sqrt(common_variance(off[presses], sd[presses])) * student_95(many) / NORMAL_95)
        if spreads:
            out[[k for k, other in enumerate(conditions) if other == condition]] = max(spreads)
    return out


def common_variance(off: Floats, sd: Floats) -> float:
    """The variance v for which the mean of off^2 / (sd^2 + v) is 1; 0 where the deviations `sd` alone explain `off`.

    A press that its image hardly determines counts little, however large its deviation.
    """
    from scipy.optimize import brentq  # slow to import

    def excess(variance: float) -> float:
        return float(np.mean(off**2 / (np.maximum(sd**2, 1e-12) + variance))) - 1.0

    return 0.0 if excess(0.0) <= 0.0 else float(brentq(excess, 0.0, float(np.mean(off**2))))
