"""Findings of a report in sentences: what was measured, how well models predict it, and whether to trust it.

Page and terminal say the same; the terminal has its own, shorter tables.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from rich.table import Table

from brushloop.calibrate.compare import Key
from brushloop.calibrate.report import Point, brush_and_size, source_note, source_point
from brushloop.calibrate.scores import Stat
from brushloop.calibrate.stats import CEILING, NEAR_POINTS, Interval, Summary, is_near
from brushloop.calibrate.validate.run import FITTED_HELD_OUT, HELD_OUT, PRESSES
from brushloop.calibrate.validate.tables import (
    NORMAL,
    STRICT,
    Report,
    Session,
    TableRow,
    missed_mm,
    robot_writing,
    table_2,
    table_3,
)
from brushloop.calibrate.writing.compare import Table3Row

WIDE_SCALE = 0.005
"""Relative width of pix2len's interval above which it matters: half a percent of every length."""
MUCH_REFUSED = 0.05
MOVED_MM = 0.3
"""Difference between two zero touches of one session that exceeds their combined repeatability."""
MISSED_MM = 0.1
"""Difference between the commanded and the reached depth above which a report says so."""
MAX_NAMED = 6
MAX_REFUSED = 20
"""Refused strokes listed on the terminal."""
SHORT = {HELD_OUT: ", held out", "fitted, in sample": ", in sample"}
"""What a model knows of the strokes, shortened for the terminal."""


def measured(report: Report) -> str:
    """Summary of the strokes and models that were compared."""
    compared, strokes = (sum(getattr(s, name) for s in report.sessions) for name in ("compared", "strokes"))
    brush = next(filter(None, (brush_and_size(s.header) for s in report.sessions)), "a brush that is not named")
    at = f" at {len(report.cells)} combinations of press depth H and brush tilt α" if report.cells else ""
    left = f", {strokes - compared} more could not be used" if strokes > compared else ""
    models = sum(model.basis != PRESSES for model in report.models)
    return (
        f"{compared} brush presses{at} (sessions: {len(report.sessions)}) were compared with what {models} stroke "
        f"models predict for them{left}. Each press is one vertical dab of {brush} ({report.label})."
    )


def headline(report: Report) -> Iterator[tuple[str, float]]:
    """Name and average CSIM, in percent, of CCD-BSM as published, of the model shown, and of a perfect model."""
    shown = "" if report.shown == "ccd-bsm" else report.shown
    names = {"ccd-bsm": "CCD-BSM as published", shown: _label(report, shown), CEILING: "a perfect model (the ceiling)"}
    for name, label in names.items():
        if (csim := _csim(report, name)) is not None:
            yield label, csim.avg


def verdict(report: Report) -> Iterator[str]:
    """How well the model shown predicts, and how large the marks are."""
    csim, top = _csim(report, report.shown), _csim(report, CEILING)
    if csim is not None:
        below = f", {_points(csim)} below the ceiling of {top.avg:.1f} %" if top and csim.below_ceiling else ""
        unseen = " from cells that it has not seen" if report.shown == FITTED_HELD_OUT else ""
        label = _label(report, report.shown)
        yield f"{label} predicts presses{unseen} with an average CSIM of {csim.avg:.1f} %{below}."
    ratios = [session.size_ratio for session in report.sessions if session.size_ratio is not None]
    if ratios:
        length, width = (sum(side) / len(ratios) for side in zip(*ratios, strict=True))
        yield f"The marks are {length:.2f} times as long and {width:.2f} times as wide as CCD-BSM predicts."


def trust(report: Report) -> Iterator[Point]:
    """Points to check before trusting the numbers."""
    yield source_point(report.source)
    strokes = sum(s.strokes for s in report.sessions)
    lost = len({(r.session_id, r.stroke_id) for r in report.refused if "does not predict it" not in r.why})
    if lost:
        words = f"{lost} of {strokes} strokes could not be used; each is named below, with the reason."
        yield Point(lost <= MUCH_REFUSED * strokes, words)
    else:
        yield Point(True, "Every stroke that counted was used.")
    for session in report.sessions:
        for point in _session(session):
            yield Point(point.good, f"{session.session_id}: {point.text}")
    yield from _models(report)
    for loop in report.loops:
        yield loop.answer
    if any("in sample" in model.basis for model in report.models):
        words = "Rows “in sample” were fitted to the very strokes that they predict: read the held-out rows instead."
        yield Point(None, words)


def _session(session: Session) -> Iterator[Point]:
    """What the pictures alone do not show: strokes that were left out, paper that moved, a scale that is not known."""
    miss, collected, scale = session.deepest_miss, session.collected, session.calibration
    if miss is not None and missed_mm(miss) > MISSED_MM:
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
        takes = f"{len(collected.pressed_again)} of {collected.photographed} takes"
        yield Point(None, f"{takes} did not count and were pressed again: the remaining strokes are a selection.")
    if collected is not None and collected.moved_mm > MOVED_MM:
        words = f"two zero touches differ by {collected.moved_mm:.2f} mm ({', '.join(collected.touches[:MAX_NAMED])})"
        yield Point(False, f"{words}: presses with the same H do not have the same depth.")
    if session.cut:
        words = f"{len(session.cut)} strokes are cut by the edge of their photograph or cell"
        yield Point(False, f"{words}: their scores are too low.")
    if scale is not None:
        width = (scale.mm_per_px_high - scale.mm_per_px_low) / scale.mm_per_px
        words = f"scale known to ±{50 * width:.3f} %, board seen to {scale.rms_px:.2f} px."
        yield Point(width <= WIDE_SCALE, words)


def _models(report: Report) -> Iterator[Point]:
    """Whether there is a ceiling, and where the calibrated model stands."""
    if _csim(report, CEILING) is None:
        words = "No cell was pressed twice: the repeatability of the brush is unknown, and there is no ceiling."
        yield Point(False, words)
    held = _csim(report, FITTED_HELD_OUT)
    if held is not None and held.below_ceiling is not None:
        near = is_near(held.below_ceiling, held.below_interval)
        words = f"The calibrated model is {_points(held)} below the ceiling; the goal is {NEAR_POINTS:g}"
        yield Point(near, f"{words} (CSIM, mm, binary).")
    elif held is None and not report.source.imported:
        yield Point(None, "No model was calibrated to this brush: run “brushloop fit”, then validate again.")


def _csim(report: Report, model: str, key: Key = STRICT) -> Summary | None:
    stat = report.stat(model, key)
    return None if stat is None else stat.csim


def _points(csim: Summary) -> str:
    return f"{csim.below_ceiling:.1f} points{_span(csim.below_interval)}"


def _span(interval: Interval | None) -> str:
    return "" if interval is None else " (95 % {:.1f} to {:.1f})".format(*interval)


def _label(report: Report, name: str) -> str:
    model = report.model(name)
    return name if model is None else model.label


def terminal_lines(report: Report) -> Iterator[object]:
    """Tables and lines for the terminal; the extremes of the scores are on the page."""
    names = ", ".join(session.session_id for session in report.sessions[:4])
    yield f"{names}: {source_note(report.source)}"
    yield measured(report)
    rows = [[*table_2(report, key), *robot_writing(report, key)] for key in (NORMAL, STRICT)]
    yield _terminal_table(f"averages, binary, ink = 1, percent ({report.label})", *rows)
    for record in report.written:
        for name in record.characters:
            rows = [table_3(record, name, alignment) for alignment in (NORMAL[0], STRICT[0])]
            yield _terminal_table(f"Table 3: {name}, averages, binary, percent ({report.label})", *rows)
    yield " ".join(verdict(report))
    for point in trust(report):
        yield f"{'•' if point.good is None else '✓' if point.good else '✗'} {point.text}"
    for press in report.refused[:MAX_REFUSED]:
        yield f"not used: {press.session_id} {press.stroke_id}: {press.why}"
    if len(report.refused) > MAX_REFUSED:
        yield f"and {len(report.refused) - MAX_REFUSED} more, in the report"


def _terminal_table(title: str, like: Sequence[TableRow], strict: Sequence[TableRow]) -> Table:
    """Each row in both alignments; the paper's numbers are of the first."""
    table = Table("model", "n", "size-\nnormalised\nCSIM / SSIM", "paper's\navg", "mm\nCSIM / SSIM", title=title)
    for row, other in itertools.zip_longest(like, strict):
        if row.scores is not None:
            words = [_pair(row.scores), "", "" if other is None else _pair(other.scores)]
            if row.paper is not None:
                words[1] = f"{row.paper.csim[2]:.2f} / {row.paper.ssim[2]:.2f}"
            table.add_row(row.label + SHORT.get(row.basis, ""), str(row.scores.csim.n), *words)
    return table


def _pair(scores: Stat | Table3Row | None) -> str:
    return "" if scores is None else f"{scores.csim.avg:.2f} / {scores.ssim.avg:.2f}"
