"""What `brushloop validate` prints: the short of the report."""

from __future__ import annotations

from collections.abc import Iterator

from rich.markup import escape
from rich.table import Table

from calibrate.drags import DEPTH_NAMES, LENGTH_NAME, DragResults
from calibrate.field import Alignment, Tone
from calibrate.presses import PressResults
from calibrate.tables import table
from calibrate.validation import Validation
from calibrate.wording import fit_sentences, source_note


def summary(validation: Validation) -> Iterator[Table | str]:
    """Renderables for the terminal."""
    results = validation.results
    yield escape(f"{validation.header.session_id}: {source_note(validation.header.source)}")
    if isinstance(results, PressResults):
        for alignment in (Alignment.SIZE_NORMALISED, Alignment.MM):
            yield _scores(results, alignment, f"{alignment}, binary, ink = 1, percent ({validation.header.source})")
    else:
        yield _drags(results)
        yield from (escape(sentence) for sentence in fit_sentences(results))
    for stroke_id, why in results.refused:
        yield escape(f"not used: {stroke_id}: {why}")


def _scores(results: PressResults, alignment: Alignment, title: str) -> Table:
    # The paper's numbers stand beside the table that was made as its own was, as far as it tells.
    beside = alignment is Alignment.SIZE_NORMALISED
    columns = ["model", "n", "CSIM max", "min", "avg", "SSIM max", "min", "avg", *(["paper's avg"] if beside else [])]
    out = Table(*columns, title=escape(title))
    for row in table(results.scores, alignment, Tone.BINARY):
        paper = "" if row.paper_csim_avg is None else f"{row.paper_csim_avg:.2f} / {row.paper_ssim_avg:.2f}"
        cells = [row.model, str(row.n), *(f"{v:.2f}" for v in (*row.csim, *row.ssim))]
        out.add_row(*cells, *([paper] if beside else []))
    return out


def _drags(results: DragResults) -> Table:
    names = sorted({name for drag in results.strokes for name in drag.commanded})
    # The rest of what was commanded is in the CSV and the report: a terminal is 80 columns wide.
    shown = [n for n in (LENGTH_NAME, *DEPTH_NAMES, "tilt_deg") if n in names]
    columns = [*(f"commanded {n}" for n in shown), "length mm", "width mm", "at middle", "area mm²", "whole"]
    out = Table("stroke", *columns, title="commanded beside measured")
    out.columns[0].overflow = "fold"
    for drag in results.strokes:
        m = drag.measured
        sizes = (f"{m.length_mm:.2f}", f"{m.width_mm:.2f}", f"{m.mid_width_mm:.2f}", f"{m.area_mm2:.1f}")
        values = (f"{drag.commanded[n]:.2f}" if n in drag.commanded else "" for n in shown)
        out.add_row(escape(drag.stroke_id), *values, *sizes, "no" if drag.cut else "yes")
    return out
