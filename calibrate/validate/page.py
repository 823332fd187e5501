"""What a report of presses says, on its page and on the terminal: sentences, tables and figures.

The page is one self-contained file, and every figure shows its source in the picture itself. The paper's figures 3, 7,
8, 10 and 11 are pictures of presses; scores and losses are charts. Findings are the same sentences in both places.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from brushloop.calibrate.compare import KEYS, NORMAL, STRICT, TABLE_3, Key
from brushloop.calibrate.errors import CalibrationError
from brushloop.calibrate.report import (
    BLUE,
    COLOURS,
    ORANGE,
    Point,
    brush_and_size,
    chart_uri,
    picture_grid,
    printable,
    render,
    source_note,
    source_point,
)
from brushloop.calibrate.scores import MEASURES, Stat
from brushloop.calibrate.stats import CEILING, NEAR_POINTS, Floats, Summary, is_near
from brushloop.calibrate.validate import run, tables
from brushloop.calibrate.validate.run import FITTED_HELD_OUT, ModelInfo, Outcome
from brushloop.calibrate.validate.tables import Report, Session, TableRow
from brushloop.calibrate.writing.compare import Table3Row

CONDITION_COLUMNS = ("ccd-bsmg", "ccd-bsm", FITTED_HELD_OUT, run.BEZIER_REFITTED, CEILING)
MAX_REFUSED_IN_TERMINAL = 20
MAX_SAMPLES = 15
WIDE_SCALE = 0.005
"""Relative width of pix2len's interval above which it matters: half a percent of every length."""
MUCH_REFUSED = 0.05
MOVED_MM = 0.3
"""Difference between two zero touches of one session that exceeds their combined repeatability."""
MISSED_MM = 0.1
"""Difference between the commanded and the reached depth above which a report says so."""
MAX_NAMED = 6
ANSWERS = {True: "Yes", False: "No, not closely enough", None: "Not certain"}
"""Whether the model predicts the brush: whether all, none or a part of its interval is within the goal."""
SHORT = {run.HELD_OUT: ", held out", "fitted, in sample": ", in sample"}
"""What a model knows of the strokes, shortened for the terminal."""
MAX_POINTS = 200
MAX_CONDITIONS, EXTREMES = 5, 6
Curve = tuple[str, Floats, Floats]
"""Name, steps and validation losses of a training."""


def page_of(
    outcome: Outcome,
    report: Report,
    curves: Sequence[Curve],
    beside: Sequence[str],
    figures_13: Sequence[tuple[str, str]] = (),
) -> str:
    """The whole page. `beside` names the data files in its folder.

    `figures_13` are sessions of characters and their pictures as data URIs.
    """
    best, worst = extremes(outcome, report.shown)
    # Some captures next to the prediction of every model: the paper's figures 3, 10 and 11.
    pressed = [outcome.scores.presses[k] for k in first_of_conditions(outcome, MAX_CONDITIONS)]
    return render(
        "report.html.j2",
        report=report,
        note=source_note(report.source),
        beside=beside,
        verdict=verdict(report),
        measured=measured(report),
        trust=list(trust(report)),
        table_one=tables.table_1(report),
        table_two=tables.table_2(report),
        table_three=tables.table_3,
        figures_13=figures_13,
        paper_three=list(TABLE_3.values()),
        plot=distributions(outcome, report),
        keys=KEYS,
        strict=STRICT,
        normal=NORMAL,
        headline=list(headline(report)),
        part=part_with_ceiling(_csim(report, report.shown)),
        scores=[(key, _scores(report, key)) for key in KEYS],
        condition_columns=[model for name in CONDITION_COLUMNS if (model := report.model(name)) is not None],
        conditions=outcome.scores.conditions() if report.stats else {},
        samples=[pictured(outcome, k, report.shown) for k in first_of_conditions(outcome, MAX_SAMPLES)],
        labels={model.info.name: model.info.label for group in outcome.models.values() for model in group},
        lines=[(press, outcome.predicted(press)[0]) for press in pressed],
        drawn_by=_label(report, report.shown),
        best=[pictured(outcome, k, report.shown) for k in best],
        worst=[pictured(outcome, k, report.shown) for k in worst],
        steps=by_strokes(report) if report.by_strokes else "",
        curves=losses(curves) if curves else "",
    )


def _scores(report: Report, key: Key) -> list[tuple[ModelInfo, Stat, int, int]]:
    """Each model with its scores in one alignment and tone, and its rank by average CSIM and SSIM."""
    rows = [(model, stat) for model in report.models if (stat := report.stat(model.name, key)) is not None]
    by_csim, by_ssim = (np.argsort(np.argsort([-getattr(stat, of).avg for _, stat in rows])) for of in MEASURES)
    return [(*row, int(first), int(second)) for row, first, second in zip(rows, by_csim, by_ssim, strict=True)]


def read_curve(text: str) -> Curve:
    """Read `NAME=FOLDER`, a folder that `brushloop train` wrote. Raises `CalibrationError` if it holds no curve."""
    name, _, folder = text.partition("=")
    path = Path(folder) / "validation.csv"
    try:
        steps, mse = np.loadtxt(path, delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2).T
        return name, steps, mse
    except (OSError, ValueError) as error:
        what = "cannot be read" if isinstance(error, OSError) else "is not a table of validation losses (step, mse)"
        raise CalibrationError(str(path), what) from None


def extremes(outcome: Outcome, model: str) -> tuple[list[int], list[int]]:
    """Numbers of the best and of the worst presses of a model, from the outermost; none without a model."""
    if not model:
        return [], []
    csim = outcome.scores.of_key(model, STRICT)[:, 0]
    order: list[int] = np.argsort(csim, kind="stable")[: np.count_nonzero(np.isfinite(csim))].tolist()
    count = min(EXTREMES, max(1, len(order) // 2))
    return order[::-1][:count], order[:count]


def pictured(outcome: Outcome, k: int, model: str) -> dict[str, Any]:
    """A press with what the model predicts for it, their difference, and their scores: the paper's figures 7 and 8."""
    press, csim, ssim = outcome.scores.presses[k], np.nan, np.nan
    drawn = outcome.predicted(press)[0].get(model)
    if drawn is not None:
        csim, ssim = 100.0 * outcome.scores.of_key(model, STRICT)[k]
    return {"press": press, "drawn": drawn, "scored": bool(np.isfinite(csim)), "csim": csim, "ssim": ssim}


def first_of_conditions(outcome: Outcome, most: int) -> list[int]:
    """The first capture of each condition; with more than `most` of them, of evenly spaced ones."""
    first = [numbers[0] for numbers in outcome.scores.conditions().values()]
    count = min(len(first), most)
    return [first[n * (len(first) - 1) // max(count - 1, 1)] for n in range(count)]


def distributions(outcome: Outcome, report: Report) -> str:
    """CSIM of every stroke by model in both alignments, with the average and its interval."""
    models = [model for name in outcome.scores.models if (model := report.model(name)) is not None][::-1]
    figure, [axes] = picture_grid(1, 2, (10.6, 1.2 + 0.32 * len(models)), report.label)
    for axis, key in zip(axes, (STRICT, NORMAL), strict=True):
        rng = np.random.default_rng(0)  # jitter only, so that points do not hide each other
        for place, model in enumerate(models):
            stat = report.stat(model.name, key)
            if stat is None:
                continue
            csim = 100.0 * outcome.scores.of_key(model.name, key)[:, 0]
            csim = csim[np.isfinite(csim)][:: max(1, -(-len(csim) // MAX_POINTS))]
            jitter = place + 0.14 * rng.uniform(-1, 1, len(csim))
            axis.plot(csim, jitter, "o", color=BLUE, alpha=0.6, markersize=2, markeredgewidth=0)
            if stat.csim.avg_interval is not None:
                axis.plot(stat.csim.avg_interval, [place] * 2, color=ORANGE, linewidth=2.0)
            axis.plot([stat.csim.avg] * 2, [place - 0.3, place + 0.3], color=ORANGE, linewidth=2.0)
        axis.set_yticks(range(len(models)), [printable(model.label) for model in models])
        axis.set(title=f"{key[0]}, binary", xlabel="CSIM, %")
    return chart_uri(figure)


def by_strokes(report: Report) -> str:
    """CSIM on presses that were not fitted, against the number of presses that were."""
    figure, [[axis]] = picture_grid(1, 1, (7.2, 3.6), report.label)
    counts = sorted({step.strokes for step in report.by_strokes})
    for name, colour in (("CCD-BSM", ORANGE), ("Bézier", BLUE)):
        csim = [[s.csim for s in report.by_strokes if (s.model, s.strokes) == (name, count)] for count in counts]
        means = [np.mean(of_count) if of_count else np.nan for of_count in csim]
        axis.plot(counts, means, "o-", color=colour, label=f"{name} fitted")
    axis.set(title="mm, binary", xlabel="presses that were fitted", ylabel="CSIM on all others, %", xscale="log")
    axis.set_xticks(counts, map(str, counts))
    axis.set_xticks([], minor=True)
    return chart_uri(figure)


def losses(curves: Sequence[Curve]) -> str:
    """Validation losses of generators side by side: the paper's figure 9, also for the strokes of figure 12."""
    figure, [[axis]] = picture_grid(1, 1, (7.2, 3.6), "networks trained on exact images of stroke models")
    for (name, steps, mse), colour in zip(curves, itertools.cycle(COLOURS), strict=False):
        axis.plot(steps, mse, "o-", color=colour, markersize=3, label=printable(name))
    axis.set(xlabel="step", ylabel="validation loss (MSE)", yscale="log")
    return chart_uri(figure)


def measured(report: Report) -> str:
    """Summary of the strokes and models that were compared."""
    compared, strokes = (sum(getattr(s, name) for s in report.sessions) for name in ("compared", "strokes"))
    brush = brush_and_size(report.sessions[0].header)
    conditions = {stat.cell for stat in report.stats} - {None}
    at = f" at {len(conditions)} combinations of press depth H and brush tilt α" if conditions else ""
    left = f", {strokes - compared} more could not be used" if strokes > compared else ""
    models = sum(model.basis != run.PRESSES for model in report.models)
    sessions = f"{len(report.sessions)} sessions" if len(report.sessions) > 1 else "one session"
    return (
        f"{compared} brush presses{at}, from {sessions}, were compared with what {models} stroke models predict for "
        f"them{left}. Each press goes straight down and up, with {brush} ({report.source})."
    )


def headline(report: Report) -> Iterator[tuple[str, float]]:
    """Name and average CSIM in percent of CCD-BSM, the model shown and the ceiling, over the presses that have one."""
    csim = None
    for name in dict.fromkeys(("ccd-bsm", report.shown)):
        if (csim := _csim(report, name)) is not None:
            yield "CCD-BSM as published" if name == "ccd-bsm" else _label(report, name), csim.below_avg or csim.avg
    if csim is not None and csim.below_avg is not None and csim.below_ceiling is not None:
        yield "a perfect model (the ceiling)", csim.below_avg + csim.below_ceiling


def part_with_ceiling(csim: Summary | None) -> str:
    """The presses that headline and verdict are about, where they are not all."""
    if csim is None or csim.below_n in (0, csim.n):
        return ""
    return f"over the {csim.below_n} of {csim.n} presses whose condition was pressed more than once"


def verdict(report: Report) -> str:
    """Whether, and how well, the model shown predicts; empty where none was compared."""
    csim = _csim(report, report.shown)
    if csim is None:
        return ""
    part = f" ({part})" if (part := part_with_ceiling(csim)) else ""
    unseen = " of conditions that were left out of its fit" if report.shown == FITTED_HELD_OUT else ""
    avg = csim.avg if csim.below_avg is None else csim.below_avg
    says = f"{_label(report, report.shown)} predicts presses{unseen} with an average CSIM of {avg:.1f} %{part}"
    if csim.below_ceiling is None:
        return f"It cannot be said: no condition was pressed twice, so there is no ceiling. {says}."
    top = avg + csim.below_ceiling
    below = round(top, 1) - round(avg, 1)  # so that the printed numbers add up
    span = "" if csim.below_interval is None else " (95 % interval: {:.1f} to {:.1f})".format(*csim.below_interval)
    return (
        f"{ANSWERS[is_near(below, csim.below_interval)]}: {says}, {below:.1f} points{span} below the ceiling of "
        f"{top:.1f} %; the goal is {NEAR_POINTS:g} points or less."
    )


def trust(report: Report) -> Iterator[Point]:
    """Points to check before trusting the numbers."""
    yield source_point(report.source)
    strokes = sum(s.strokes for s in report.sessions)
    if lost := len(report.lost):
        words = f"{lost} of {strokes} strokes could not be used; each is named below, with the reason."
        yield Point(lost <= MUCH_REFUSED * strokes, words)
    else:
        yield Point(True, "Every stroke that counted was used.")
    unpredicted = Counter(press.why.split()[0] for press in report.refused if run.NOT_PREDICTED in press.why)
    for model, count in unpredicted.items():
        yield Point(None, f"{model} does not predict {count} of {strokes} strokes: its row averages the others only.")
    for session in report.sessions:
        for point in _session(session):
            yield Point(point.good, f"{session.header.session_id}: {point.text}")
    if _csim(report, CEILING) is None:
        words = "No condition was pressed twice: the repeatability of the brush is unknown, and there is no ceiling."
        yield Point(False, words)
    if _csim(report, FITTED_HELD_OUT) is None:
        yield Point(None, "No model was calibrated to this brush: run “brushloop fit”, then validate again.")
    if _csim(report, "ccd-bsmg") is None and "ccd-bsmg" not in unpredicted:
        yield Point(None, f"CCD-BSMG is {tables.MISSING['ccd-bsmg']}.")
    for loop in report.loops:
        yield loop.answer


def _session(session: Session) -> Iterator[Point]:
    """What the pictures alone do not show: strokes that were left out, paper that moved, a scale that is not known."""
    miss, collected, scale = session.deepest_miss, session.collected, session.calibration
    if miss is not None and tables.missed_mm(miss) > MISSED_MM:
        yield Point(
            False,
            f"commanded and reached depth differ by more than {MISSED_MM:g} mm, most at "
            f"{miss.stroke_id}: {miss.depth_mm:g} mm was commanded, {miss.reached_mm:.2f} mm was reached.",
        )
    if collected is not None and collected.left_out:
        of = "" if collected.planned is None else f" of {collected.planned} planned"
        names = ", ".join(collected.left_out[:MAX_NAMED]) + (", ..." if len(collected.left_out) > MAX_NAMED else "")
        yield Point(False, f"{len(collected.left_out)}{of} strokes were left out during collection: {names}.")
    if collected is not None and collected.pressed_again:
        words = f"{len(collected.pressed_again)} of {collected.photographed} photographed strokes were pressed again"
        yield Point(None, f"{words}, after a failed check or on request. Only the new presses are compared.")
    if collected is not None and collected.moved_mm > MOVED_MM:
        words = f"two zero touches differ by {collected.moved_mm:.2f} mm ({', '.join(collected.touches[:MAX_NAMED])})"
        yield Point(False, f"{words}: presses with the same H do not have the same depth.")
    if session.cut:
        words = f"{len(session.cut)} strokes are cut by the edge of their photograph, patch or crop"
        yield Point(False, f"{words}: their scores are too low.")
    if scale is not None:
        words = f"the scale is known to ±{100 * scale.relative_reach:.3f} %, board corners to {scale.rms_px:.2f} px."
        yield Point(2.0 * scale.relative_reach <= WIDE_SCALE, words)


def _csim(report: Report, model: str) -> Summary | None:
    stat = report.stat(model, STRICT)
    return None if stat is None else stat.csim


def _label(report: Report, name: str) -> str:
    model = report.model(name)
    return name if model is None else model.label


def terminal_lines(report: Report) -> Iterator[object]:
    """Tables and lines for the terminal; the extremes of the scores are on the page."""
    names = ", ".join(session.header.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield measured(report)
    rows = [[*tables.table_2(report, key), *tables.robot_writing(report, key)] for key in (NORMAL, STRICT)]
    yield _terminal_table(f"averages, binary, ink = 1, percent ({report.label})", *rows)
    for record in report.written:
        for name in record.characters:
            rows = [tables.table_3(record, name, alignment) for alignment in (NORMAL[0], STRICT[0])]
            yield _terminal_table(f"Table 3: {name}, averages, binary, percent ({report.label})", *rows)
    yield f"Does CCD-BSM predict this brush? {verdict(report)}"
    for point in trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for press in report.refused[:MAX_REFUSED_IN_TERMINAL]:
        used = "not used" if press[:2] in report.lost else "not compared with every model"
        yield f"{used}: {press.session_id} {press.stroke_id}: {press.why}"
    if len(report.refused) > MAX_REFUSED_IN_TERMINAL:
        yield f"and {len(report.refused) - MAX_REFUSED_IN_TERMINAL} more, in the report"


def _terminal_table(title: str, like: Sequence[TableRow], strict: Sequence[TableRow]) -> Table:
    """Each row in both alignments; the paper's numbers are of the first."""
    table = Table("model", "n", "size-\nnormalised\nCSIM / SSIM", "paper's\navg", "mm\nCSIM / SSIM", title=title)
    for row, other in itertools.zip_longest(like, strict):
        if row.scores is not None:
            paper = "" if row.paper is None else f"{row.paper.csim[2]:.2f} / {row.paper.ssim[2]:.2f}"
            words = _pair(row.scores), paper, "" if other is None else _pair(other.scores)
            table.add_row(row.label + SHORT.get(row.basis, ""), str(row.scores.csim.n), *words)
    return table


def _pair(scores: Stat | Table3Row | None) -> str:
    return "" if scores is None else f"{scores.csim.avg:.2f} / {scores.ssim.avg:.2f}"
