"""Gates for scripts: limits a score must meet, as `csim_avg>=0.90` or `ccd-bsm-heldout:mm:binary:csim_avg>=0.93`."""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.validate.report.data import Report
from brushloop.sessions.disk import number

OPERATORS: dict[str, Callable[[float, float], bool]] = {
    ">=": operator.ge,
    "<=": operator.le,
    ">": operator.gt,
    "<": operator.lt,
}
STATISTICS = ("avg", "median", "min", "max")
FORM = re.compile(
    r"^(?P<where>(?:[^:<>=]+:)*)(?P<measure>csim|ssim)_(?P<statistic>\w+)\s*(?P<op>>=|<=|>|<)\s*(?P<limit>\S+)$"
)


class GateMissed(Exception):
    """A score misses its gate; the report is still written."""

    exit_code: ClassVar[int] = 5

    def __init__(self, missed: list[str]) -> None:
        self.missed = missed
        super().__init__("gate missed: " + "; ".join(missed))


@dataclass(frozen=True, slots=True)
class Gate:
    """One condition; without a model it applies to the report's calibrated model, or else to the first."""

    text: str
    model: str
    alignment: Alignment
    tone: Tone
    measure: str
    statistic: str
    op: str
    limit: float


def parse_gate(text: str) -> Gate:
    """Parse a gate. Raises `CalibrationError`."""
    found = FORM.match(text.strip())
    if found is None:
        raise _bad(text, "expected [MODEL:][ALIGNMENT:][TONE:]csim_avg>=0.90")
    model, alignment, tone = "", Alignment.SIZE_NORMALISED, Tone.BINARY
    for part in found["where"].split(":")[:-1]:
        if part in list(Alignment):
            alignment = Alignment(part)
        elif part in list(Tone):
            tone = Tone(part)
        elif not model:
            model = part
        else:
            raise _bad(text, f"names two models, {model!r} and {part!r}")
    if found["statistic"] not in STATISTICS:
        raise _bad(text, f"{found['statistic']!r} is not one of {', '.join(STATISTICS)}")
    try:
        limit = number(found["limit"])
    except ValueError:
        raise _bad(text, f"{found['limit']!r} is not a number") from None
    if not 0.0 <= limit <= 1.0:
        raise _bad(text, f"{limit:g} is outside 0 to 1")
    return Gate(text.strip(), model, alignment, tone, found["measure"], found["statistic"], found["op"], limit)


def check_gates(report: Report, gates: list[Gate]) -> None:
    """Check the gates. Raises `GateMissed` naming all missed ones, `CalibrationError` for a model without scores."""
    missed: list[str] = []
    for gate in gates:
        model = gate.model or report.shown
        stat = report.stat(model, gate.alignment, gate.tone, gate.measure)
        if stat is None:
            known = ", ".join(dict.fromkeys(one.model for one in report.stats))
            raise _bad(gate.text, f"{model!r} has no score; scored: {known}")
        found: float | None = getattr(stat, gate.statistic)
        if found is None:
            raise _bad(gate.text, f"the {model} is an average and has no {gate.statistic}")
        value = 0.01 * found
        if not OPERATORS[gate.op](value, gate.limit):
            which = f"{model}, {gate.alignment}, {gate.tone}"
            missed.append(f"{gate.text}: {gate.measure}_{gate.statistic} of {which} is {value:.4f} ({report.label})")
    if missed:
        raise GateMissed(missed)


def _bad(text: str, what: str) -> CalibrationError:
    return CalibrationError(f"--gate {text}", what)
