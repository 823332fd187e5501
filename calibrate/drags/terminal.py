"""What `brushloop validate` prints of strokes that travel: the short of the report."""

from __future__ import annotations

from collections.abc import Iterator

from rich.table import Table

from calibrate.drags.measure import DEPTH_NAMES, LENGTH_NAME, DragResults
from calibrate.drags.report import DragValidation
from calibrate.report.wording import fit_sentences, source_note


def summary(validation: DragValidation) -> Iterator[Table | str]:
    """Renderables for the terminal."""
    results = validation.results
    yield f"{validation.header.session_id}: {source_note(validation.header.source)}"
    yield _drags(results)
    yield from fit_sentences(results)
    for stroke_id, why in results.refused:
        yield f"not used: {stroke_id}: {why}"


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
        out.add_row(drag.stroke_id, *values, *sizes, "no" if drag.cut else "yes")
    return out
