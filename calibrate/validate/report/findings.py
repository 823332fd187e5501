"""Findings of a report in sentences: what was measured, how well models predict it, and whether to trust it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator

from brushloop.calibrate.compare.paper import ORDER
from brushloop.calibrate.compare.place import Alignment, Tone
from brushloop.calibrate.compare.score import Polarity
from brushloop.calibrate.loop.scores import AGAIN, ANOTHER, LoopRecord
from brushloop.calibrate.report import Point, source_point
from brushloop.calibrate.stats import CEILING, NEAR_POINTS, is_near
from brushloop.calibrate.validate import candidates as who
from brushloop.calibrate.validate.report.data import Report, Session, Stat
from brushloop.calibrate.validate.run import ANOTHER as ANOTHER_PRESS
from brushloop.calibrate.writing.scores import REFERENCE
from brushloop.sessions.records import Source

CLOSE = 0.5
"""Points below which two models count as equal."""
FEW_REPEATS = 3
WIDE_SCALE = 0.005
"""Relative width of pix2len's interval above which it matters: half a percent of every length."""
MUCH_REFUSED = 0.05
MOVED_MM = 0.3
"""Difference between two zero touches of one session that exceeds their combined repeatability."""
MISSED_MM = 0.1
"""Difference between the commanded and the reached depth above which a report says so."""
MAX_NAMED = 6


def measured(report: Report) -> str:
    """Summary of the strokes and models that were compared."""
    cells = {one.cell for one in report.stats if one.cell is not None}
    compared, strokes = (sum(getattr(s, name) for s in report.sessions) for name in ("compared", "strokes"))
    many = f"{len(report.sessions)} sessions" if len(report.sessions) > 1 else "one session"
    where = f" at {len(cells)} combinations of press depth H and brush tilt α" if cells else ""
    brush = next((one.brush for one in report.sessions if one.brush), "a brush that is not named")
    left = "" if compared == strokes else f", {strokes - compared} more could not be used"
    what = {
        Source.LOOPBACK: "The brush, the ink and the photographs are simulated",
        Source.REAL: "A robot arm pressed them on paper, a camera photographed them",
        Source.IMPORT: "They are photographs from elsewhere",
        Source.IMPORT_SIMULATED: "They are pictures of simulated ink from elsewhere",
    }[report.source]
    return (
        f"{compared} brush presses{where}, from {many}, were compared with what {_count(report)} stroke models predict "
        f"for them{left}. Each press is one vertical dab of {brush}. {what} ({report.label})."
    )


def verdict(report: Report) -> Iterator[str]:
    """The report in at most three sentences: how well the model shown predicts, beside what, and on what ink."""
    shown, top, bezier, published = (
        _avg(report, name) for name in (report.shown, CEILING, who.BEZIER_REFITTED, "ccd-bsm")
    )
    if shown is not None:
        below = "" if top is None or shown.below is None else f"{_below(shown)} of {top.avg:.1f} %"
        unseen = " from cells that it has not seen" if report.shown == who.FITTED_HELD_OUT else ""
        label = _label(report, report.shown)
        yield f"{label} predicts presses{unseen} with an average CSIM of {shown.avg:.1f} %{below}."
    others = [f"a Bézier stroke fitted to the same captures reaches {bezier.avg:.1f} %"] if bezier is not None else []
    if published is not None and report.shown != "ccd-bsm":
        others.append(f"CCD-BSM as published reaches {published.avg:.1f} %")
    if others:
        words = " and ".join(others)
        yield f"{words[0].upper()}{words[1:]}."
    yield {
        Source.LOOPBACK: "The brush and its ink are simulated, so this tests the method and says nothing about paper.",
        Source.REAL: "The ink is real: pressed by the arm and photographed, as the recording says.",
        Source.IMPORT: "The photographs come from elsewhere; their scale and commands were not measured here.",
        Source.IMPORT_SIMULATED: "The ink was simulated elsewhere, so this says nothing about paper.",
    }[report.source]


def findings(report: Report) -> Iterator[str]:
    """How well the models predict: the ceiling, the best model that had not seen the strokes, the published one."""
    again, top = _avg(report, ANOTHER_PRESS), _avg(report, CEILING)
    if again is not None and top is not None:
        yield (
            f"Repeatability of the brush: one press predicts another of the same H and α with a CSIM of "
            f"{again.avg:.1f} %. A perfect model of this brush, which draws the best image of each cell, would reach "
            f"{_interval(top)}: this is the ceiling, and no model can be expected to do better."
        )
    held, bezier = _avg(report, who.FITTED_HELD_OUT), _avg(report, who.BEZIER_REFITTED)
    if held is not None:
        unseen = "on cells that the fit had not seen"
        yield f"Calibrated to this brush, CCD-BSM reaches {_interval(held)}{_below(held)}, {unseen}."
    tuned = _avg(report, who.GENERATOR_HELD_OUT)
    if tuned is not None:
        yield f"Tuned to this brush, CCD-BSMG reaches {_interval(tuned)}{_below(tuned)}, on cells that it had not seen."
    if bezier is not None:
        peer = "" if held is None else f": {abs(held.avg - bezier.avg):.1f} points {_less(bezier.avg, held.avg)}"
        yield f"A Bézier stroke fitted to the same captures reaches {_interval(bezier)}{peer}."
    yield from _pressed_again(report)
    yield from _characters(report)
    published = [(rival, _avg(report, rival.name)) for rival in report.rivals if rival.name in ("ccd-bsmg", "ccd-bsm")]
    for rival, stat in published:
        if stat is not None:
            yield f"{rival.label} {rival.basis}, given only the brush's size, H and α, reaches {_interval(stat)}."
    if published:
        yield from _sizes(report)
    if held is None and not report.source.imported:
        yield "No model was calibrated to this brush: run “brushloop fit”, then validate again."


def _pressed_again(report: Report) -> Iterator[str]:
    for loop in report.loops:
        again, other = (loop.row(what, Alignment.MM, Tone.BINARY) for what in (AGAIN, ANOTHER))
        if again is None:
            continue
        others = "" if other is None else f", other presses of the same H and α {other.csim[2]:.1f} %"
        yield (
            f"Pressed again from their photographs alone ({loop.again}), {again.n} strokes match their "
            f"originals with a CSIM of {again.csim[2]:.1f} %{others}."
        )


def _characters(report: Report) -> Iterator[str]:
    for record in report.written:
        for row in record.table_3:
            key = (row.pair, row.alignment, row.tone, row.polarity)
            if key == (REFERENCE, Alignment.MM, Tone.BINARY, Polarity.INK):
                yield (
                    f"{row.character}, written {row.n} times by the arm, matches its reference ({row.reference}) with "
                    f"a CSIM of {row.csim[2]:.1f} %."
                )


def _sizes(report: Report) -> Iterator[str]:
    known = [
        (s.length_ratio, s.width_ratio)
        for s in report.sessions
        if s.length_ratio is not None and s.width_ratio is not None
    ]
    if not known:
        return
    length, width = (sum(ratio[k] for ratio in known) / len(known) for k in (0, 1))
    yield f"The marks are {length:.2f} times as long and {width:.2f} times as wide as CCD-BSM predicts."


def order(report: Report) -> str:
    """Whether the models rank in the paper's order, size-normalised and binary."""
    found = {
        name: stat.avg
        for name in ORDER
        if (stat := report.stat(name, Alignment.SIZE_NORMALISED, Tone.BINARY, "csim")) is not None
    }
    if len(found) < 3:
        return ""
    ours = sorted(found, key=lambda name: -found[name])
    wanted = [name for name in ORDER if name in found]
    words = " > ".join(f"{_label(report, name)} {found[name]:.1f}" for name in ours)
    close = [
        f"{_label(report, a)} and {_label(report, b)}"
        for a, b in itertools.pairwise(ours)
        if found[a] - found[b] < CLOSE
    ]
    near = f" Too close to separate: {'; '.join(close)}." if close else ""
    if ours == wanted:
        return f"By average CSIM in the size-normalised alignment the models have the paper's order: {words}.{near}"
    swapped = [
        f"{_label(report, b)} before {_label(report, a)}"
        for k, a in enumerate(wanted)
        for b in wanted[k + 1 :]
        if found[b] > found[a]
    ]
    return (
        f"By average CSIM in the size-normalised alignment: {words}. The paper's order differs: here "
        f"{', '.join(swapped)}. Uncalibrated models have the proportions of the paper's brush. If those of this brush "
        "differ, a model can win by its size alone, and the order says little about the models." + near
    )


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
    for one in report.sessions:
        yield from _collection(one)
    cut = sum(len(s.cut) for s in report.sessions)
    if cut:
        yield Point(False, f"{cut} strokes are cut by the edge of their photograph or cell: their scores are too low.")
    for one in report.sessions:
        if one.mm_per_px is None or one.mm_per_px_interval is None:
            continue
        width = (one.mm_per_px_interval.high - one.mm_per_px_interval.low) / one.mm_per_px
        words = f"{one.session_id}: scale known to ±{50 * width:.3f} %, board seen to {one.board_rms_px:.2f} px."
        yield Point(width <= WIDE_SCALE, words)
    repeats = [s.n for s in report.stats if s.cell is not None and s.model == CEILING]
    if not repeats:
        yield Point(
            False, "No cell was pressed twice: the repeatability of the brush is unknown, and there is no ceiling."
        )
    elif min(repeats) < FEW_REPEATS:
        words = (
            f"Some cells were pressed only {min(repeats)} times, so the ceiling is rough. The paper presses ten times."
        )
        yield Point(None, words)
    held, bezier = (_avg(report, name) for name in (who.FITTED_HELD_OUT, who.BEZIER_REFITTED))
    if held is not None and held.below is not None:
        span = held.below_interval
        near = is_near(held.below, None if span is None else (span.low, span.high))
        how = {True: "within", False: "not within", None: "not certainly within"}[near]
        yield Point(
            near,
            f"The calibrated model is {how} {NEAR_POINTS} points of the ceiling (mm, binary, CSIM): {_points(held)}.",
        )
    if held is not None and bezier is not None and held.avg < bezier.avg:
        yield Point(False, "The refitted Bézier predicts unseen cells better than the calibrated CCD-BSM.")
    for loop in report.loops:
        yield from _verdict(loop)
    if any("in sample" in rival.basis for rival in report.rivals):
        words = "Rows “in sample” were fitted to the very strokes that they predict: read the held-out rows instead."
        yield Point(None, words)


def _collection(one: Session) -> Iterator[Point]:
    """Points that the recording alone does not show: planned strokes that were left out, and paper that moved."""
    miss = one.deepest_miss
    if miss is not None and abs(miss.reached_mm - miss.depth_mm) > MISSED_MM:
        yield Point(
            False,
            f"{one.session_id}: commanded and reached depth differ by more than {MISSED_MM:g} mm, most at "
            f"{miss.stroke_id}: {miss.depth_mm:g} mm was commanded, {miss.reached_mm:.2f} mm was reached.",
        )
    collected = one.collected
    if collected is None:
        return
    if collected.left_out:
        of = "" if collected.planned is None else f" of {collected.planned} planned"
        some = ", ".join(collected.left_out[:MAX_NAMED]) + (", ..." if len(collected.left_out) > MAX_NAMED else "")
        words = f"{one.session_id}: {len(collected.left_out)}{of} strokes were left out during collection: {some}."
        yield Point(False, words)
    if collected.pressed_again:
        takes = f"{len(collected.pressed_again)} of {collected.photographed} takes"
        yield Point(
            None,
            f"{one.session_id}: {takes} did not count and were pressed again: the remaining strokes are a selection.",
        )
    if collected.moved_mm > MOVED_MM:
        words = f"two zero touches differ by {collected.moved_mm:.2f} mm ({', '.join(collected.touches[:MAX_NAMED])})"
        yield Point(False, f"{one.session_id}: {words}: presses with the same H do not have the same depth.")


def _verdict(loop: LoopRecord) -> Iterator[Point]:
    if not loop.verdicts:
        yield Point(None, f"{loop.again}: no original cell was pressed twice, so its repeatability is unknown.")
        return
    least = min(loop.verdicts, key=lambda verdict: verdict.difference)
    failed = sum(not verdict.holds for verdict in loop.verdicts)
    how = "at most" if not failed else f"in {failed} of {len(loop.verdicts)} comparisons more than"
    sure = "" if all(verdict.certain for verdict in loop.verdicts) else ", not certain in all"
    yield Point(
        not failed,
        f"Strokes pressed again ({loop.again}) are {how} {loop.goal_points:g} point less similar to their originals "
        f"than other presses of the same cell (least: {least.difference:+.2f} points{sure}).",
    )


def _avg(report: Report, model: str) -> Stat | None:
    return report.stat(model, Alignment.MM, Tone.BINARY, "csim")


def _interval(stat: Stat) -> str:
    span = stat.avg_interval
    return f"{stat.avg:.1f} %" + ("" if span is None else f" (95 % {span.low:.1f} to {span.high:.1f})")


def _points(stat: Stat) -> str:
    span = stat.below_interval
    return f"{stat.below:.1f} points" + ("" if span is None else f" (95 % {span.low:.1f} to {span.high:.1f})")


def _below(stat: Stat) -> str:
    return "" if stat.below is None else f", {_points(stat)} below the ceiling"


def _count(report: Report) -> int:
    return sum(rival.basis != "captured presses" for rival in report.rivals)


def _label(report: Report, name: str) -> str:
    return next((rival.label for rival in report.rivals if rival.name == name), name)


def _less(one: float, other: float) -> str:
    return "less" if one < other else "more"
