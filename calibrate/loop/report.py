"""`brushloop loop compare` as a function, and its report: a page, a picture, and every number as CSV and JSON."""

from __future__ import annotations

import itertools
import platform
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.compare import MM_PER_PX
from brushloop.calibrate.compare.paper import ROBOT_WRITING, TABLE_1
from brushloop.calibrate.compare.place import KEYS, SIZE_PX, Alignment, Field, Image, Tone
from brushloop.calibrate.loop.compare import (
    AGAIN,
    GOAL_POINTS,
    NOT_AGAIN,
    LoopComparison,
    LoopRecord,
    Pair,
    Verdict,
    compare_sessions,
)
from brushloop.calibrate.loop.compare import FILE as NUMBERS
from brushloop.calibrate.report import (
    BLUE,
    Point,
    Written,
    about,
    dress,
    ink_uri,
    overlay,
    overlay_uri,
    picture_grid,
    plot,
    plot_uri,
    recording_facts,
    render,
    save_picture,
    show_picture,
    source_point,
    write_files,
)
from brushloop.model.similarity import SSIM_SETTINGS
from brushloop.sessions.disk import check_writable, csv_text
from brushloop.sessions.terminal import Progress, unseen

HEADLINE, GRAY = (Alignment.MM, Tone.BINARY), (Alignment.MM, Tone.GRAY)
PICTURE, PAGE, TABLE = "loop.png", "loop.html", "loop.csv"
COLUMNS = ("original", "again", "depth_mm", "tilt_deg", "what", "alignment", "tone", "csim", "ssim", "source")
SHEET_ROWS = slice(32, 96)
"""Rows shown, the middle half: a press is at most half as thick as the field is high."""
MAX_PICTURE_ROWS = 12
MAX_PAIRS_SHOWN = 150


@dataclass(frozen=True, slots=True)
class CompareRequest:
    """Which sessions are compared, and where the report goes."""

    original: Path
    again: Path
    """The session of the replay protocol."""
    out: Path
    command: str
    """Named by the report as what made it."""
    fit: Path | None = None
    """Brush fit that recovered depth and tilt; None is CCD-BSM as published."""
    mm_per_px: float = MM_PER_PX


def compare(request: CompareRequest, progress: Progress = unseen) -> Written:
    """Compare presses with those that repeat them, and write the report. Raises `CalibrationError` and OSError."""
    check_writable(request.out)
    view = Field(mm_per_px=request.mm_per_px)
    loop = compare_sessions(request.original, request.again, request.fit, view, request.command, progress)
    page = write_loop(loop, request.out)
    return Written(page, (*summary(loop.record), f"Picture: {request.out / PICTURE}", f"Report:  {page}"))


def write_loop(loop: LoopComparison, folder: Path) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(loop, folder / PICTURE)
    record, header = loop.record, loop.original.header
    frame = about(header.model_copy(update={"source": record.source}))
    page = render(
        "loop.html.j2",
        **frame,
        header=header,
        record=record,
        trust=[source_point(record.source), *_trust(record)],
        plot=_recovered(loop, frame["label"]),
        beside=(PICTURE, TABLE, NUMBERS),
        answer=answer(record.verdicts),
        tables=[(key, [row for row in record.table_1 if (row.alignment, row.tone) == key]) for key in KEYS],
        paper=TABLE_1[ROBOT_WRITING],
        rows=_rows(loop),
        not_shown=max(0, len(loop.pairs) - MAX_PAIRS_SHOWN),
        ssim_settings=SSIM_SETTINGS,
        provenance=list(_provenance(loop)),
    )
    write_files(folder, {TABLE: loop_csv(loop), NUMBERS: record.to_json(), PAGE: page})
    return folder / PAGE


def answer(verdicts: Sequence[Verdict]) -> str:
    """The result in one sentence."""
    if not verdicts:
        return "No cell of the original session was pressed twice, so its repeatability is not known."
    failed = [v for v in verdicts if not v.holds]
    least = min(verdicts, key=lambda v: v.difference)
    where = f"least: {least.difference:+.2f} points, {least.measure.upper()}, {least.alignment}, {least.tone}"
    if not failed:
        return (
            f"In all {len(verdicts)} comparisons the re-pressed strokes are as similar to their originals as the "
            f"brush's own presses are to each other, or less than {GOAL_POINTS:g} point less similar ({where})."
        )
    return (
        f"In {len(failed)} of {len(verdicts)} comparisons the re-pressed strokes score more than {GOAL_POINTS:g} "
        f"point below other presses of the same cell against their originals ({where})."
    )


def summary(record: LoopRecord) -> Iterator[str]:
    """Lines for the terminal."""
    yield f"{record.pairs} presses repeated, {len(record.refused)} not compared ({record.source})"
    for key in KEYS:
        rows = [row for row in record.table_1 if (row.alignment, row.tone) == key]
        parts = "; ".join(f"{row.model} {row.csim.avg:.2f} / {row.ssim.avg:.2f}" for row in rows)
        yield f"{key[0]}, {key[1]}, CSIM / SSIM: {parts}"
    yield answer(record.verdicts)


def loop_csv(loop: LoopComparison) -> str:
    """A CSV row for every comparison with every original."""
    rows: list[tuple[object, ...]] = []
    for pair, of_pair in zip(loop.pairs, loop.scores.values, strict=True):
        asked = pair.original.condition
        names = pair.original.stroke.stroke_id, pair.again.stroke.stroke_id, asked.depth_mm, asked.tilt_deg
        for (k, key), (m, what) in itertools.product(enumerate(KEYS), enumerate(loop.scores.models)):
            if np.isfinite(of_pair[m, k, 0]):
                rows.append((*names, what, *key, *(f"{score:.6f}" for score in of_pair[m, k]), loop.record.source))
    return csv_text(COLUMNS, rows)


def draw(loop: LoopComparison, path: Path) -> None:
    """Draw one row per pair: original, simulation of the recovered press, re-pressed, overlay. Raises OSError."""
    chosen = _in_picture(loop)
    title = f"{loop.record.original}, pressed again ({loop.record.source})"
    figure, rows = picture_grid(len(chosen), 4, (10.0, 0.6 + 1.35 * len(chosen)), title)
    side = SIZE_PX * loop.record.mm_per_px
    extent = (0.0, side, 0.25 * side, 0.75 * side)
    scores = loop.scores.of_key(AGAIN, HEADLINE)
    for k, axes in zip(chosen, rows, strict=True):
        pair = loop.pairs[k]
        asked, recovered = pair.original.condition, pair.again.condition
        titles = (
            f"{pair.original.stroke.stroke_id}: H {asked.depth_mm:g} mm, alpha {asked.tilt_deg:g} deg",
            f"recovered: H {recovered.depth_mm:.2f} mm, alpha {recovered.tilt_deg:.1f} deg",
            "re-pressed: CSIM {:.3f}, SSIM {:.3f}".format(*scores[k]),
            "gray both, orange original only, blue again only",
        )
        original, simulated, again = _gray_images(pair)
        images = (original, simulated, again, overlay(original, again))
        for axis, image, text in zip(axes, images, titles, strict=True):
            show_picture(axis, image, text, fontsize=7, extent=extent)
    save_picture(figure, path)


def _in_picture(loop: LoopComparison) -> list[int]:
    """Numbers of at most `MAX_PICTURE_ROWS` pairs, evenly over depth and tilt, the worst included."""
    pairs = loop.pairs
    ordered = sorted(range(len(pairs)), key=lambda k: (pairs[k].original.condition, pairs[k].again.stroke.stroke_id))
    if len(pairs) <= MAX_PICTURE_ROWS:
        return ordered
    worst = int(loop.scores.of_key(AGAIN, GRAY)[:, 0].argmin())
    evenly: list[float] = np.linspace(0, len(pairs) - 1, MAX_PICTURE_ROWS - 1).tolist()
    chosen = {worst, *(ordered[round(k)] for k in evenly)}
    return [k for k in ordered if k in chosen]


def _gray_images(pair: Pair) -> list[Image]:
    """Original, simulated and re-pressed, the middle of each field."""
    return [images[GRAY][SHEET_ROWS] for images in (pair.original.images, pair.simulated, pair.again.images)]


def _rows(loop: LoopComparison) -> Iterator[dict[str, Any]]:
    """The pairs, those that are least alike first."""
    scores = loop.scores.of_key(AGAIN, HEADLINE)
    order: list[int] = scores[:, 0].argsort(kind="stable").tolist()
    for k in order[:MAX_PAIRS_SHOWN]:
        pair = loop.pairs[k]
        original, simulated, again = _gray_images(pair)
        images = {
            "original": ink_uri(original),
            "recovered, simulated": ink_uri(simulated),
            "pressed again": ink_uri(again),
            "original and pressed again": overlay_uri(original, again),
        }
        yield {"original": pair.original, "again": pair.again, "percent": 100.0 * scores[k], "images": images}


def _trust(record: LoopRecord) -> Iterator[Point]:
    failed = sum(not v.holds for v in record.verdicts)
    uncertain = sum(not v.certain for v in record.verdicts)
    if not record.verdicts:
        yield Point(None, "No cell of the original session was pressed twice: the brush's repeatability is not known.")
    elif failed:
        yield Point(False, f"{failed} of {len(record.verdicts)} comparisons miss the goal of {GOAL_POINTS:g} point.")
    else:
        yield Point(True, f"All {len(record.verdicts)} comparisons stay within {GOAL_POINTS:g} point of another press.")
    if uncertain:
        words = "there are so few presses that the interval includes the limit or is not known"
        yield Point(None, f"{uncertain} of {len(record.verdicts)} comparisons are not certain: {words}.")
    if record.in_sample:
        words = "The model that recovered them was fitted to these same presses, with their commanded depths and tilts"
        yield Point(
            None, f"{words}: recovered numbers near the commanded ones prove nothing about it. Compare the marks."
        )
    left = sum(why == NOT_AGAIN for _, why in record.refused)
    if left:
        yield Point(None, f"{'One original was' if left == 1 else f'{left} originals were'} not pressed again.")
    if len(record.refused) > left:
        yield Point(False, f"{len(record.refused) - left} strokes could not be compared; each is named below.")
    else:
        yield Point(True, "Every stroke that was pressed again was compared.")


def _recovered(loop: LoopComparison, label: str) -> str:
    """Depth and tilt as recovered against as commanded, with the line where both are equal."""
    figure, axes = plot(1, 2, (10.0, 3.8))
    pairs = [(pair.original.condition, pair.again.condition) for pair in loop.pairs]
    values = (
        ("depth H, mm", [(original.depth_mm, again.depth_mm) for original, again in pairs]),
        ("tilt α, deg", [(original.tilt_deg, again.tilt_deg) for original, again in pairs]),
    )
    for axis, (name, points) in zip(axes, values, strict=True):
        low, high = min(map(min, points)), max(map(max, points))
        margin = 0.05 * (high - low) or 0.5
        axis.plot([low - margin, high + margin], [low - margin, high + margin], color="0.6", lw=1.0)
        axis.plot([x for x, _ in points], [y for _, y in points], "o", ms=4, alpha=0.6, color=BLUE)
        dress(axis, f"{name.split(',')[0]} ({label})", f"commanded {name}", f"recovered {name}")
    return plot_uri(figure)


def _provenance(loop: LoopComparison) -> Iterator[list[tuple[str, str]]]:
    for session in (loop.original, loop.again):
        yield recording_facts(session.header, session.recording.path.name, session.sha256, session.calibration)
    record = loop.record
    yield [
        ("recovered by", record.model),
        ("compared with", f"{record.software}, Python {platform.python_version()}"),
        ("command", record.command),
    ]
