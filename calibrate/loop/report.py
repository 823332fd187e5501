"""Write the loop's report: one self-contained HTML page, a picture, and every number behind them as CSV and JSON."""

from __future__ import annotations

import platform
from collections.abc import Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from brushloop.calibrate.compare.paper import ROBOT_WRITING, TABLE_1
from brushloop.calibrate.compare.place import KEYS, Alignment, Tone
from brushloop.calibrate.compare.score import SSIM_SETTINGS
from brushloop.calibrate.loop.compare import NOT_AGAIN, ComparedSession, LoopComparison
from brushloop.calibrate.loop.scores import AGAIN, GOAL_POINTS, LoopRecord, Pair, PairScore, Table1Row
from brushloop.calibrate.loop.scores import FILE as NUMBERS
from brushloop.calibrate.report import (
    BLUE,
    Point,
    ink_uri,
    overlay,
    overlay_uri,
    picture_grid,
    plot,
    plot_uri,
    render,
    save_picture,
    show_picture,
    source_label,
    source_note,
    source_point,
    write_files,
)
from brushloop.sessions.disk import csv_text

HEADLINE, GRAY = (Alignment.MM, Tone.BINARY), (Alignment.MM, Tone.GRAY)
PICTURE, PAGE, TABLE = "loop.png", "loop.html", "loop.csv"
SHEET_ROWS = slice(32, 96)
"""Rows shown, the middle half: a press is at most half as thick as the field is high."""
MAX_PICTURE_ROWS = 12
MAX_PAIRS_SHOWN = 150


def write_loop(loop: LoopComparison, folder: Path, command: str) -> Path:
    """Write the report's files into `folder`; returns the page's path. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    draw(loop, folder / PICTURE)
    header, source = loop.original.header, loop.again.header.source
    paper = TABLE_1[ROBOT_WRITING]
    label = source_label(source, [header.brush])
    page = render(
        "loop.html.j2",
        header=header,
        again=loop.again.header,
        label=label,
        note=source_note(source, header.brush),
        trust=[source_point(source), *_trust(loop)],
        plot=_recovered(loop, label),
        beside=(PICTURE, TABLE, NUMBERS),
        model=loop.model,
        goal=f"{GOAL_POINTS:g}",
        pairs=len(loop.paired.pairs),
        answer=answer(loop),
        verdicts=loop.verdicts,
        tables=_tables(loop.table),
        paper=(paper.csim, paper.ssim),
        rows=_rows(loop),
        not_shown=max(0, len(loop.paired.pairs) - MAX_PAIRS_SHOWN),
        refused=loop.paired.refused,
        field=loop.field,
        ssim_settings=SSIM_SETTINGS,
        provenance=list(_provenance(loop, command)),
    )
    record = record_of(loop, command)
    write_files(folder, {TABLE: loop_csv(loop.scores, source), NUMBERS: record.to_json(), PAGE: page})
    return folder / PAGE


def answer(loop: LoopComparison) -> str:
    """Return the result in one sentence."""
    if not loop.verdicts:
        return "No cell of the original session was pressed twice, so its repeatability is not known."
    failed = [v for v in loop.verdicts if not v.holds]
    least = min(loop.verdicts, key=lambda v: v.difference)
    where = f"{least.measure.upper()}, {least.alignment}, {least.tone}"
    if not failed:
        return (
            f"In all {len(loop.verdicts)} comparisons the re-pressed strokes are as similar to their originals as the "
            f"brush's own presses are to each other, or less than {GOAL_POINTS:g} point less similar "
            f"(least: {least.difference:+.2f} points, {where})."
        )
    return (
        f"In {len(failed)} of {len(loop.verdicts)} comparisons the re-pressed strokes score more than {GOAL_POINTS:g} "
        f"point below other presses of the same cell against their originals (least: {least.difference:+.2f} "
        f"points, {where})."
    )


def summary(loop: LoopComparison) -> Iterator[str]:
    """Lines for the terminal."""
    source = loop.again.header.source
    yield f"{len(loop.paired.pairs)} presses repeated, {len(loop.paired.refused)} not compared ({source})"
    for alignment, tone in KEYS:
        rows = [row for row in loop.table if (row.alignment, row.tone) == (alignment, tone)]
        parts = "; ".join(f"{row.what} {row.csim[2]:.2f} / {row.ssim[2]:.2f}" for row in rows)
        yield f"{alignment}, {tone}, CSIM / SSIM: {parts}"
    yield answer(loop)


def loop_csv(scores: list[PairScore], source: str) -> str:
    """Return a CSV row for every comparison with every original."""
    head = ["original", "again", "depth_mm", "tilt_deg", "what", "alignment", "tone", "csim", "ssim", "source"]
    rows = (
        (s.original, s.again, *astuple(s.condition)[:2], s.what, s.alignment, s.tone, f"{s.csim:.6f}", f"{s.ssim:.6f}")
        for s in scores
    )
    return csv_text(head, ((*row, source) for row in rows))


def record_of(loop: LoopComparison, command: str) -> LoopRecord:
    """Return the loop without images and individual scores, with its digest."""
    return LoopRecord(
        source=loop.again.header.source,
        original=loop.original.header.session_id,
        original_sha256=loop.original.sha256,
        again=loop.again.header.session_id,
        again_sha256=loop.again.sha256,
        model=loop.model,
        in_sample=loop.in_sample,
        mm_per_px=loop.field.mm_per_px,
        pairs=len(loop.paired.pairs),
        goal_points=GOAL_POINTS,
        table_1=tuple(loop.table),
        verdicts=tuple(loop.verdicts),
        refused=tuple(loop.paired.refused),
        software=loop.software,
        command=command,
    ).sealed()


def draw(loop: LoopComparison, path: Path) -> None:
    """Draw one row per pair: original, simulation of the recovered press, re-pressed, overlay. Raises OSError."""
    pairs = _in_picture(loop)
    scores = _again_scores(loop)
    title = f"{loop.original.header.session_id}, pressed again ({loop.again.header.source})"
    figure, rows = picture_grid(len(pairs), 4, (10.0, 0.6 + 1.35 * len(pairs)), title)
    side = loop.field.side_mm
    extent = (0.0, side, 0.25 * side, 0.75 * side)
    for pair, axes in zip(pairs, rows, strict=True):
        original, again = pair.original, pair.again
        score = scores[again.stroke_id]
        titles = (
            f"{original.stroke_id}: H {original.condition.depth_mm:g} mm, alpha {original.condition.tilt_deg:g} deg",
            f"recovered: H {again.condition.depth_mm:.2f} mm, alpha {again.condition.tilt_deg:.1f} deg",
            f"re-pressed: CSIM {score.csim:.3f}, SSIM {score.ssim:.3f}",
            "gray both, orange original only, blue again only",
        )
        images = _gray_images(pair)
        images.append(overlay(images[0], images[2]))
        for axis, image, text in zip(axes, images, titles, strict=True):
            show_picture(axis, image, text, fontsize=7, extent=extent)
    save_picture(figure, path)


def _in_picture(loop: LoopComparison) -> list[Pair]:
    """Choose at most `MAX_PICTURE_ROWS` pairs, evenly over depth and tilt, the worst included."""
    pairs = sorted(loop.paired.pairs, key=lambda p: (p.original.condition, p.again.stroke_id))
    if len(pairs) <= MAX_PICTURE_ROWS:
        return pairs
    worst = min((s for s in loop.scores if (s.what, s.alignment, s.tone) == (AGAIN, *GRAY)), key=lambda s: s.csim)
    chosen = {round(k) for k in np.linspace(0, len(pairs) - 1, MAX_PICTURE_ROWS - 1)}
    chosen |= {k for k, pair in enumerate(pairs) if pair.again.stroke_id == worst.again}
    return [pairs[k] for k in sorted(chosen)]


def _again_scores(loop: LoopComparison) -> dict[str, PairScore]:
    """Score of each repetition by name, from the headline comparison (mm, binary)."""
    return {s.again: s for s in loop.scores if (s.what, s.alignment, s.tone) == (AGAIN, *HEADLINE)}


def _gray_images(pair: Pair) -> list[Any]:
    """Original, simulated and re-pressed, the middle of each field."""
    return [image[GRAY][SHEET_ROWS] for image in (pair.original.images, pair.simulated, pair.again.images)]


def _tables(rows: list[Table1Row]) -> list[dict[str, Any]]:
    """Return one table per alignment and tone."""
    return [
        {"alignment": key[0], "tone": key[1], "rows": [row for row in rows if (row.alignment, row.tone) == key]}
        for key in KEYS
    ]


def _rows(loop: LoopComparison) -> list[dict[str, Any]]:
    scores = _again_scores(loop)
    pairs = sorted(loop.paired.pairs, key=lambda p: scores[p.again.stroke_id].csim)
    rows: list[dict[str, Any]] = []
    for pair in pairs[:MAX_PAIRS_SHOWN]:
        images = _gray_images(pair)
        rows.append(
            {
                "original": pair.original,
                "again": pair.again,
                "score": scores[pair.again.stroke_id],
                "images": {
                    "original": ink_uri(images[0]),
                    "recovered, simulated": ink_uri(images[1]),
                    "pressed again": ink_uri(images[2]),
                    "original and pressed again": overlay_uri(images[0], images[2]),
                },
            }
        )
    return rows


def _trust(loop: LoopComparison) -> Iterator[Point]:
    failed = [v for v in loop.verdicts if not v.holds]
    uncertain = sum(not v.certain for v in loop.verdicts)
    if not loop.verdicts:
        yield Point(None, "No cell of the original session was pressed twice: the brush's repeatability is not known.")
    elif failed:
        yield Point(False, f"{len(failed)} of {len(loop.verdicts)} comparisons miss the goal of {GOAL_POINTS:g} point.")
    else:
        yield Point(True, f"All {len(loop.verdicts)} comparisons stay within {GOAL_POINTS:g} point of another press.")
    if uncertain:
        words = "there are so few presses that the interval includes the limit or is not known"
        yield Point(None, f"{uncertain} of {len(loop.verdicts)} comparisons are not certain: {words}.")
    if loop.in_sample:
        words = "The model that recovered them was fitted to these same presses, with their commanded depths and tilts"
        yield Point(
            None,
            f"{words}: recovered numbers near the commanded ones prove nothing about it. Compare the marks.",
        )
    left = sum(why == NOT_AGAIN for _, why in loop.paired.refused)
    if left:
        yield Point(None, f"{'One original was' if left == 1 else f'{left} originals were'} not pressed again.")
    if len(loop.paired.refused) > left:
        yield Point(False, f"{len(loop.paired.refused) - left} strokes could not be compared; each is named below.")
    else:
        yield Point(True, "Every stroke that was pressed again was compared.")


def _recovered(loop: LoopComparison, label: str) -> str:
    """Depth and tilt as recovered against as commanded, with the line where both are equal."""
    figure, axes = plot(1, 2, (10.0, 3.8))
    pairs = [(pair.original.condition, pair.again.condition) for pair in loop.paired.pairs]
    values = (
        ("depth H, mm", [(one.depth_mm, other.depth_mm) for one, other in pairs]),
        ("tilt α, deg", [(one.tilt_deg, other.tilt_deg) for one, other in pairs]),
    )
    for axis, (name, points) in zip(axes, values, strict=True):
        low, high = min(map(min, points)), max(map(max, points))
        margin = 0.05 * (high - low) or 0.5
        axis.plot([low - margin, high + margin], [low - margin, high + margin], color="0.6", lw=1.0)
        axis.plot([x for x, _ in points], [y for _, y in points], "o", ms=4, alpha=0.6, color=BLUE)
        axis.set_xlabel(f"commanded {name}")
        axis.set_ylabel(f"recovered {name}")
        axis.set_title(f"{name.split(',')[0]} ({label})", fontsize=10)
        axis.grid(alpha=0.3)
    return plot_uri(figure)


def _provenance(loop: LoopComparison, command: str) -> Iterator[tuple[str, str]]:
    for name, session in (("original", loop.original), ("re-pressed", loop.again)):
        yield from _of_session(name, session)
    header = loop.again.header
    yield "robot", f"{header.robot} {header.robot_firmware}".strip()
    yield "brush, ink, paper", ", ".join(part for part in (header.brush, header.ink, header.paper) if part)
    yield "recovered by", loop.model
    yield "compared with", f"{loop.software}, Python {platform.python_version()}"
    yield "command", command


def _of_session(name: str, session: ComparedSession) -> Iterator[tuple[str, str]]:
    yield f"{name}, source", str(session.header.source)
    yield f"{name}, recording", f"{session.recording.name}, sha256 {session.sha256}"
    if session.calibration is not None:
        calibration = session.calibration
        yield f"{name}, calibration", f"{calibration.named}, pix2len {calibration.mm_per_px:.5f} mm/px"
